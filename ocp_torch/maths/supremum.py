"""Suprema over the torus: sampled, then climbed by local ascent from the worst points."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator

# The first step of an ascent, and the factors by which steps grow on success and shrink on failure. One of each together
# shrinks them: an ascent that has come near a maximum goes on in smaller steps.
FIRST_STEP, GROWTH, SHRINKAGE = 1e-2, 1.5, 0.4
# Ascents whose steps are all below this, in turns, have arrived: in one dimension after 30 of 60 to 100 steps, in two after
# 40 to 90. The maximum is then the same to 15 digits where the function is smooth, to 9 or more for slacks beside kinks.
ARRIVED = 1e-7
# How often `minimiser` narrows its interval: (2/3)^30 of it is left.
NARROWINGS = 30


@dataclass(frozen=True)
class Extremum:
    """A supremum as it was found: an estimate from below of the true one, with what was done to find it."""

    value: float
    x: Tensor  # (d,) where it is attained
    points: int  # states sampled
    ascents: int  # local ascents started from the largest of them


@torch.no_grad()
def batched(function: Callable[[Tensor], Tensor], x: Tensor, chunk: int = 1024) -> Tensor:
    """``function`` over the rows of ``x`` in chunks, so that memory stays bounded."""
    return torch.cat([function(part) for part in x.split(chunk)])


def supremum(
    function: Callable[[Tensor], Tensor],
    points: Tensor,
    ascents: int = 32,
    steps: int = 60,
    start_step: float = FIRST_STEP,
    differentiable: bool = True,
) -> Extremum:
    """The largest value of ``function`` ``(N, d) -> (N,)`` met at ``points`` and on ascents from the ``ascents`` best.

    Each ascent moves along the normalised gradient (or, when ``differentiable`` is false, along random directions) with
    a step that grows on success and shrinks on failure, so a value never goes down. A NaN anywhere is returned as NaN.
    """
    values = batched(function, points)
    if torch.isnan(values).any():
        worst = int(torch.isnan(values).nonzero()[0])
        return Extremum(float("nan"), points[worst], len(points), 0)
    count = min(ascents, len(points))
    best, index = values.topk(count)
    x, best = climb(function, points[index], best, steps if count else 0, start_step, differentiable)
    top = int(torch.isnan(best).nonzero()[0]) if torch.isnan(best).any() else int(best.argmax())
    return Extremum(float(best[top]), x[top].remainder(1.0), len(points), count)


def climb(
    function: Callable[[Tensor], Tensor],
    x: Tensor,
    best: Tensor,
    steps: int = 60,
    start_step: float = FIRST_STEP,
    differentiable: bool = True,
) -> tuple[Tensor, Tensor]:
    """Where local ascents from ``x`` ``(N, d)``, with values ``best`` ``(N,)``, end, and the values there, after so many
    ``steps`` or once all have arrived; they stop at the first NaN that any of them meets, which is then the value of its
    row."""
    step = torch.full_like(best, start_step)
    generator = fixed_generator()
    slope = value_and_gradient(function, x)[1] if differentiable and steps else torch.zeros_like(x)
    for _ in range(steps):
        direction = slope if differentiable else torch.randn(x.shape, generator=generator).to(x)
        direction = direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-30)
        candidate = x + step.unsqueeze(-1) * direction
        if differentiable:
            reached, ahead = value_and_gradient(function, candidate)
        else:
            reached, ahead = batched(function, candidate), slope
        odd = torch.isnan(reached)
        better = (reached > best) | odd
        x = torch.where(better.unsqueeze(-1), candidate, x)
        best = torch.where(better, reached, best)
        if odd.any():
            break
        slope = torch.where(better.unsqueeze(-1), ahead, slope)
        step = torch.where(better, GROWTH * step, SHRINKAGE * step)
        if differentiable and float(step.max()) < ARRIVED:
            break
    return x, best


def value_and_gradient(function: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """``function`` and its gradient at each row of ``x``; that is 0 where it is one of constants, piece by piece."""
    with torch.enable_grad():
        x = x.detach().requires_grad_(True)
        value = function(x)
        if not value.requires_grad:
            return value, torch.zeros_like(x)
        (gradient,) = torch.autograd.grad(value.sum(), x, materialize_grads=True)
    return value.detach(), gradient


def minimiser(function: Callable[[float], float], low: float, high: float) -> float:
    """Where a convex ``function`` is smallest in ``[low, high]``, narrowed by thirds to `5e-6` of its length."""
    for _ in range(NARROWINGS):
        third = (high - low) / 3.0
        left, right = low + third, high - third
        low, high = (left, high) if function(right) < function(left) else (low, right)
    return 0.5 * (low + high)
