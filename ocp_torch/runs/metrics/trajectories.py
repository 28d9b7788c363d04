"""Trajectories of a closed loop at equal times, for numbers and pictures; the certificate has an integrator of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.control.policies import Policy
from ocp_torch.problems.problem import Problem


@dataclass(frozen=True)
class Path:
    """``times`` ``(K,)`` in the problem's unit, ``states`` ``(K, N, d)``, and each discounted ``cost`` ``(N,)``."""

    times: Tensor
    states: Tensor
    cost: Tensor

    def late(self, part: float = 0.25) -> Tensor:
        """The states of the last ``part`` of the time, ``(K', N, d)``."""
        return self.states[-max(1, round(part * len(self.times))) :]

    def each(self, function: Callable[[Tensor], Tensor], states: Tensor | None = None) -> Tensor:
        """``function`` of ``states`` ``(K', N, d)``, all of them by default, as ``(K', N)``."""
        x = self.states if states is None else states
        return function(x.flatten(0, 1)).reshape(x.shape[:2])


@torch.no_grad()
def simulate(problem: Problem, policy: Policy, x0: Tensor, duration: float, steps: int) -> Path:
    r"""From ``x0`` ``(N, d)`` for ``duration``, by RK4 with a control recomputed at each stage.

    The cost is `int_0^T rho e^{-rho t} (f + R(u)) dt` by the trapezoidal rule: good to a few digits, where the certificate's
    performance has an error bound.
    """
    h, rho = duration / steps, problem.discount
    velocity = lambda x: problem.velocity(x, policy(x))
    rate = lambda x, u: problem.state_cost(x) + problem.control_cost.cost(u)
    times = h * torch.arange(steps + 1, dtype=x0.dtype)
    weight = rho * h * (-rho * times).exp()
    weight[0], weight[-1] = 0.5 * weight[0], 0.5 * weight[-1]
    x, states = x0, [x0.remainder(1.0)]
    cost = torch.zeros_like(x0[:, 0])
    for k in range(steps):
        u = policy(x)
        cost = cost + weight[k] * rate(x, u)
        v1 = problem.velocity(x, u)
        v2 = velocity(x + 0.5 * h * v1)
        v3 = velocity(x + 0.5 * h * v2)
        v4 = velocity(x + h * v3)
        x = (x + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)).remainder(1.0)
        states.append(x)
    return Path(times, torch.stack(states), cost + weight[-1] * rate(x, policy(x)))
