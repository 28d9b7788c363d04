r"""Kuramoto's order parameter, and costs of synchrony made of it."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.problems.systems.angles import TURN

SYNCHRONISE, DESYNCHRONISE, ENTRAIN = "synchronise", "desynchronise", "entrain"


def order_parameter(x: Tensor) -> Tensor:
    r"""`r = |mean_j exp(2 pi i x_j)|` in [0, 1], ``(N, n) -> (N,)``: 1 in synchrony."""
    angle = TURN * x
    return torch.hypot(angle.cos().mean(dim=-1), angle.sin().mean(dim=-1))


def square_order(x: Tensor) -> Tensor:
    """`r^2`, a trigonometric polynomial, ``(N, n) -> (N,)``."""
    angle = TURN * x
    return angle.cos().mean(dim=-1).square() + angle.sin().mean(dim=-1).square()


def goal_cost(goal: str, x: Tensor) -> Tensor:
    """In [0, 1], 0 where the ``goal`` is met, at phases ``(N, n)``: `1 - r^2`, `r^2`, or `mean_j (1 - cos theta_j) / 2`."""
    if goal == ENTRAIN:
        return (0.5 * TURN * x).sin().square().mean(dim=-1)
    square = square_order(x)
    return (1.0 - square).clamp_min(0.0) if goal == SYNCHRONISE else square
