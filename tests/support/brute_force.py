"""Minima by search and gradients by differences, for closed forms to be held against."""

from __future__ import annotations

import itertools
import math

import torch

BOUND = 3.0  # C_V in Lemma 2 and M in Lemma 3


def columns(*axes) -> list[torch.Tensor]:
    """Every combination of the values on ``axes``, as float64 columns."""
    return [torch.tensor(c, dtype=torch.float64) for c in zip(*itertools.product(*axes), strict=True)]


def two_dimensional(sizes: torch.Tensor) -> torch.Tensor:
    """Vectors of these lengths, in various directions of the plane."""
    angle = torch.arange(len(sizes), dtype=sizes.dtype)
    return sizes.unsqueeze(-1) * torch.stack([angle.cos(), angle.sin()], dim=-1)


def lowest(objective, low: float, high: float) -> torch.Tensor:
    """The least value of each row's convex ``objective(mu)`` over ``[low, high]``: a log-spaced grid, refined thrice."""
    start, stop = math.log10(low), math.log10(high)
    grid = torch.linspace(start, stop, 2001, dtype=torch.float64).unsqueeze(0)
    for _ in range(4):
        values = objective(10.0**grid)
        at = values.argmin(dim=1, keepdim=True)
        left, right = (grid.expand_as(values).gather(1, (at + s).clamp(0, 2000)) for s in (-1, 1))
        grid = left + (right - left) * torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)
    return values.amin(dim=1)


def value_and_gradients(function, *inputs) -> list[torch.Tensor]:
    inputs = [t.clone().requires_grad_(True) for t in inputs]
    value = function(*inputs)
    return [value.detach(), *torch.autograd.grad(value.sum(), inputs, allow_unused=True, materialize_grads=True)]


def central_differences(function, *inputs, h=1e-6):
    """The gradient of each row's value in each entry of each input."""
    result = []
    for i, t in enumerate(inputs):
        flat = t.reshape(len(t), -1)
        slopes = []
        for k in range(flat.shape[1]):
            step = torch.zeros_like(flat)
            step[:, k] = h
            up, down = (function(*inputs[:i], (flat + s * step).reshape(t.shape), *inputs[i + 1 :]) for s in (1, -1))
            slopes.append((up - down) / (2.0 * h))
        result.append(torch.stack(slopes, dim=-1).reshape(t.shape))
    return result
