r"""The closed loop along its trajectories, and what it costs: with `V` as control variate where there is one.

For any smooth `V`, `V(x) - V^u(x) = rho int e^{-rho t} Q_u(x_t) dt` exactly along the closed loop, with the Bellman slack
`Q_u = V - f - R(u) - grad V . (a + B u) / rho`. So `Perf(u) = E[V mu0] - E int rho e^{-rho t} Q_u`, and what is left to
simulate, with all its errors, is as small as `Q_u`.

With noise `Q_u` has `D : hess V` in it, and the identity a martingale of mean 0 (Ito's formula), which is left out: paths are
those of the SDE, and what is averaged along them is `Q_u` alone (`ocp_torch.maths.brownian`).
"""

import math
from typing import cast

import torch
from torch import Tensor
from torch.nn.functional import pad

from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import Policy, ValuePolicy
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import Integrate
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# A trajectory slides where halved steps leave more than this part of `z - V`; a method of order four leaves a sixteenth.
SETTLING = 0.25


class FeedbackLoop:
    r"""`dx/dt = a + B u(x)`, the control renewed at every instant: its state is `x`, its rate `f + R(u)`.

    With ``value`` the rate is `-Q_u`. Without noise there is then one more coordinate `z`, the sum of `grad V . g` from `V`
    at the start on, and a second rate `z - V`: for every `z` with `z = V` at the start the integral of `f + R(u) - z + z' /
    rho`, discounted, is the cost less that `V`. On a sliding mode, where a controller jumps to and fro at a kink of `V`, no
    step is small enough for `grad V . g` to be the rate at which `V` changes, and `z` takes the place of `V`. Along smooth
    trajectories `z - V` vanishes with the steps.
    """

    def __init__(self, problem: Problem, policy: Policy, value: Field | None) -> None:
        self.problem, self.policy, self.value = problem, policy, value
        self.summed = value is not None and not problem.noisy

    def start(self, x: Tensor) -> Tensor:
        """The state at ``x`` ``(N, d)``."""
        return torch.cat([x, self.value(x).unsqueeze(-1)], dim=-1) if self.value is not None and self.summed else x

    def renewed(self, state: Tensor) -> Tensor:
        """The ``state`` itself: nothing of it is held."""
        return state

    def noise(self, state: Tensor) -> Tensor:
        """`sigma` at a state."""
        return cast(Tensor, self.problem.noise(state))

    def __call__(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Velocities and rates, see `Dynamics`."""
        problem, x = self.problem, state[:, : self.problem.dim]
        if self.value is None:
            return problem.motion(x, self.policy(x))
        samples = Samples.of(problem, x, divergences=False)
        generator = Generator.of(problem, samples)
        V = generator.jet(self.value)
        own = isinstance(self.policy, ValuePolicy) and self.policy.value is self.value
        u = self.policy.control(samples.B, V) if own else self.policy(x)  # type: ignore[attr-defined]
        velocity, rate = samples.velocity(u), -generator.bellman_slack(V, u)
        if not self.summed:
            return velocity, rate
        change = (V.gradient * velocity).sum(dim=-1, keepdim=True)
        return torch.cat([velocity, change], dim=-1), torch.stack([rate, state[:, -1] - V.value], dim=-1)


class HeldLoop:
    """The loop of a control that is renewed only every ``hold`` units of time: its state ``(N, d + m)`` is `x` and the
    control that is held, its rate `f + R(u)`."""

    def __init__(self, problem: Problem, policy: HeldPolicy) -> None:
        self.problem, self.policy = problem, policy
        self.hold, self.substeps = policy.pace.step, policy.pace.substeps

    def start(self, x: Tensor) -> Tensor:
        """The state at ``x`` ``(N, d)``."""
        return torch.cat([x, self.policy(x)], dim=-1)

    def renewed(self, state: Tensor) -> Tensor:
        """The ``state`` with the control that is best there."""
        return self.start(state[:, : self.problem.dim])

    def __call__(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Velocities and rates, see `Dynamics`."""
        problem = self.problem
        velocity, rate = problem.motion(*state.split([problem.dim, problem.control_dim], dim=-1))
        return pad(velocity, (0, problem.control_dim)), rate

    def noise(self, state: Tensor) -> Tensor:
        """`sigma` at a state: nothing of it moves the control."""
        return pad(cast(Tensor, self.problem.noise(state[:, : self.problem.dim])), (0, 0, 0, self.problem.control_dim))


Loop = FeedbackLoop | HeldLoop


def loop_of(problem: Problem, policy: Policy, value: Field | None) -> Loop:
    """The closed loop of ``policy``, as it is meant to be used; ``value`` is a control variate along a feedback loop."""
    return HeldLoop(problem, policy) if isinstance(policy, HeldPolicy) else FeedbackLoop(problem, policy, value)


class Sliding:
    """Results of ``count`` trajectories by `-Q_u`, less `z - V` where that stays above ``allowed`` however fine the steps."""

    def __init__(self, count: int, allowed: float) -> None:
        self.allowed = allowed
        self.off = torch.full((count,), math.inf, dtype=torch.float64)
        self.stays = torch.zeros(count, dtype=torch.bool)

    def by(self, integrate: Integrate) -> Integrate:
        """The integrator ``integrate``, whose columns are `-Q_u` and `z - V`, with its results corrected."""

        def corrected(rows: Tensor, steps: int) -> tuple[Tensor, Tensor]:
            rates, end = integrate(rows, steps)
            off = rates[:, 1].abs()
            self.stays[rows] = (off > self.allowed) & (off > SETTLING * self.off[rows])
            self.off[rows] = off
            return self.corrected(rates, rows), end

        return corrected

    def corrected(self, rates: Tensor, rows: Tensor) -> Tensor:
        """The first column of ``rates`` ``(n, 2)`` of ``rows``, less the second where that is to be taken off."""
        return torch.where(self.stays[rows], rates[:, 0] - rates[:, 1], rates[:, 0])
