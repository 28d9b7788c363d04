r"""What a closed loop costs along its trajectories, with `V` as control variate where there is one.

For any smooth `V`, `V(x) - V^u(x) = rho int e^{-rho t} Q_u(x_t) dt` exactly along the closed loop, with the Bellman slack
`Q_u = V - f - R(u) - grad V . (a + B u) / rho`. So `Perf(u) = E[V mu0] - E int rho e^{-rho t} Q_u`, and what is left to
simulate, with all its errors, is as small as `Q_u`.

For every `z` with `z = V` at the start, the integral of `f + R(u) - z + z' / rho`, discounted, is the cost less that `V`. On
a sliding mode, where a controller jumps to and fro at a kink of `V`, no step is small enough for `grad V . g` to be the rate
at which `V` changes: there `z`, the sum of `grad V . g` along the trajectory, takes the place of `V`. Along smooth
trajectories `z - V` vanishes with the steps.
"""

import math

import torch
from torch import Tensor

from ocp_torch.control.policies import Policy, ValuePolicy
from ocp_torch.maths import jets
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import Dynamics, Integrate
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# `z - V` must shrink to that part of it when steps are halved; a sixteenth is expected of a method of order four.
SETTLING = 0.25


def closed_loop_dynamics(problem: Problem, policy: Policy, value: Field | None) -> Dynamics:
    """The closed loop and what it costs; with ``value`` its slack `-Q_u`, and as one more coordinate `z`, the sum of
    `grad V . g` from `V` at the start on, with `z - V` as a second rate."""
    cost = problem.control_cost

    def dynamics(state: Tensor) -> tuple[Tensor, Tensor]:
        if value is None:
            u = policy(state)
            return problem.velocity(state, u), problem.state_cost(state) + cost.cost(u)
        x, summed = state[:, :-1], state[:, -1]
        samples = Samples.of(problem, x, divergences=False)
        generator, V = Generator.of(problem, samples), jets.jet(value, x)
        u = policy.control(samples.B, V) if isinstance(policy, ValuePolicy) and policy.value is value else policy(x)
        velocity = samples.a + torch.einsum("ndm,nm->nd", samples.B, u)
        slack = generator.bellman_slack(V, u)
        change = (V.gradient * velocity).sum(dim=-1, keepdim=True)
        return torch.cat([velocity, change], dim=-1), torch.stack([-slack, summed - V.value], dim=-1)

    return dynamics


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
