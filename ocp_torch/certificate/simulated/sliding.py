"""Trajectories that slide along a kink of `V`, for which `V` is no control variate as it stands.

For every `z` with `z = V` at the start, the integral of `f + R(u) - z + z' / rho`, discounted, is the cost less that `V`. On
a sliding mode, where a controller jumps to and fro at a kink of `V`, no step is small enough for `grad V . g` to be the rate
at which `V` changes: there `z`, the sum of `grad V . g` along the trajectory, takes the place of `V`. Along smooth
trajectories `z - V` vanishes with the steps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ocp_torch.maths.runge_kutta import Integrate

# `z - V` must shrink to that part of it when steps are halved; a sixteenth is expected of a method of order four.
SETTLING = 0.25


class Sliding:
    """Results of ``integrate`` for ``count`` trajectories, by `-Q_u`, or with `z - V` taken off where that stays above
    ``allowed`` however fine the steps."""

    def __init__(self, integrate: Integrate, count: int, allowed: float) -> None:
        self.integrate, self.allowed = integrate, allowed
        self.off = torch.full((count,), math.inf, dtype=torch.float64)
        self.stays = torch.zeros(count, dtype=torch.bool)

    def __call__(self, rows: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        rates, end = self.integrate(rows, steps)
        off = rates[:, 1].abs()
        self.stays[rows] = (off > self.allowed) & (off > SETTLING * self.off[rows])
        self.off[rows] = off
        return self.corrected(rates, rows), end

    def corrected(self, rates: Tensor, rows: Tensor) -> Tensor:
        """The first column of ``rates`` ``(n, 2)`` of ``rows``, less the second where that is to be taken off."""
        return torch.where(self.stays[rows], rates[:, 0] - rates[:, 1], rates[:, 0])
