"""The closed loop in time: a fourth-order Runge-Kutta integrator for discounted costs along trajectories."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Maps states (N, d) to velocities (N, d) and rates (N,) to be discounted and integrated along the way.
Dynamics = Callable[[Tensor], tuple[Tensor, Tensor]]


@torch.no_grad()
def discounted_integral(
    dynamics: Dynamics, x0: Tensor, rho: float, horizon: float, steps: int
) -> tuple[Tensor, Tensor]:
    r"""`int_0^T rho e^{-rho t} rate(x_t) dt` ``(N,)`` and the end states ``(N, d)``, by classical RK4 with equal steps.

    The discount multiplies the rate inside the scheme, so that state and integral are one smooth system of order 4.
    """
    h = horizon / steps
    x, total = x0, torch.zeros_like(x0[:, 0])
    decay_half, decay_full = (torch.exp(torch.tensor(-rho * s * h, dtype=x0.dtype)).item() for s in (0.5, 1.0))
    weight = rho
    for _ in range(steps):
        v1, r1 = dynamics(x)
        v2, r2 = dynamics(x + 0.5 * h * v1)
        v3, r3 = dynamics(x + 0.5 * h * v2)
        v4, r4 = dynamics(x + h * v3)
        x = x + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)
        total = total + weight * h / 6.0 * (r1 + 2.0 * decay_half * (r2 + r3) + decay_full * r4)
        weight = weight * decay_full
    return total, x.remainder(1.0)
