r"""`Perf(u) = E_{x0 ~ mu0} rho int e^{-rho t} (f + R(u)) dt` by simulation, with `V` as control variate where there is one.

For any smooth `V`, `V(x) - V^u(x) = rho int e^{-rho t} Q_u(x_t) dt` exactly along the closed loop, with the Bellman slack
`Q_u = V - f - R(u) - grad V . (a + B u) / rho`. So `Perf(u) = E[V mu0] - E int rho e^{-rho t} Q_u`, and what is left to
simulate, with all its errors, is as small as `Q_u`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch import calculus, formulas
from ocp_torch.calculus import Field
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.simulation import Dynamics, discounted_integral
from ocp_torch.control_laws import ControlLaw, ValueLaw
from ocp_torch.problems.problem import Problem
from ocp_torch.samplers import evaluation_points
from ocp_torch.samples import Samples

# Simulation sets come after those of the bounds in the stream of evaluation points.
SIMULATION_REPLICATE = 1000
# What is left of the discount when simulation stops, times the rate's supremum, relative to the answer.
TAIL = 2e-5
# A trajectory is refined until halving its step changes it by less, relative to the answer, or the budget is used.
TOLERANCE = 5e-5
MAX_DOUBLINGS = 4


@dataclass(frozen=True)
class Simulated:
    """A performance, and what the trajectories showed: the largest value met at a start and the end states."""

    perf: Estimate
    largest_value: float
    end_states: Tensor


def _dynamics(problem: Problem, law: ControlLaw, value: Field | None) -> Dynamics:
    cost, rho = problem.control_cost, problem.discount

    def dynamics(x: Tensor) -> tuple[Tensor, Tensor]:
        if value is None:
            u = law(x)
            return problem.velocity(x, u), problem.state_cost(x) + cost.cost(u)
        samples = Samples.of(problem, x, divergences=False)
        v, gradient = calculus.value_and_gradient(value, x)
        own = isinstance(law, ValueLaw) and law.value is value
        u = law.control(samples.B, gradient) if own else law(x)
        velocity = samples.a + torch.einsum("ndm,nm->nd", samples.B, u)
        return velocity, -formulas.bellman_slack(samples, v, gradient, u, cost, rho)

    return dynamics


def simulate_performance(
    problem: Problem,
    law: ControlLaw,
    trajectories: int,
    replicates: int,
    seed: int,
    value: Field | None = None,
    initial: list[float] | None = None,
) -> Simulated:
    """Perf of ``law`` from ``replicates`` independent sets of ``trajectories`` scrambled Sobol starts.

    With ``value`` its Bellman slack is simulated and ``initial``, `E[V mu0]` per replicate from many more states, is
    added. ``bias`` is the mean absolute change on halving the step, plus the rate's supremum along the trajectories
    times the discount left at the horizon.
    """
    dim, rho = problem.dim, problem.discount
    starts = [evaluation_points(trajectories, dim, SIMULATION_REPLICATE + r, seed) for r in range(replicates)]
    x0 = torch.cat(starts)
    mu0 = problem.initial_density(x0)
    dynamics = _dynamics(problem, law, value)
    with torch.no_grad():
        velocity, rate = dynamics(x0)
        base = value(x0) if value is not None else torch.zeros_like(rate)
    size = abs(sum(initial) / len(initial)) if initial else float((mu0 * rate).mean().abs())
    size = max(size, 1e-12)
    largest_rate = 2.0 * float(rate.abs().max())
    horizon = max(math.log(max(largest_rate / (TAIL * size), math.e)), 1.0) / rho
    speed = float(velocity.norm(dim=-1).max())
    steps = max(8, 2 * math.ceil(0.5 * horizon * max(rho / 0.4, speed / 0.2)))
    integrate = lambda starts, count: discounted_integral(dynamics, starts, rho, horizon, count)
    coarse, _ = integrate(x0, steps // 2)
    fine, end = integrate(x0, steps)
    change = (fine - coarse).abs()
    for _ in range(MAX_DOUBLINGS):
        # Only the trajectories that still change are refined: those that pass a kink of the controller.
        active = change > TOLERANCE * size
        if not active.any():
            break
        steps *= 2
        finer, end[active] = integrate(x0[active], steps)
        change[active], fine[active] = (finer - fine[active]).abs(), finer
    halving = float((mu0 * change).mean())
    with torch.no_grad():
        largest_rate = max(largest_rate / 2.0, float(dynamics(end)[1].abs().max()))
    tail = math.exp(-rho * horizon) * largest_rate
    parts = (mu0 * fine).reshape(replicates, trajectories).mean(dim=1).tolist()
    totals = [part + (initial[r % len(initial)] if initial else 0.0) for r, part in enumerate(parts)]
    return Simulated(Estimate.of(totals, bias=halving + tail), float((base + fine).max()), end)
