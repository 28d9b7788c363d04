"""What part of the discounted time a controller spends outside the box of a system, where the model is not the user's."""

import copy
from dataclasses import replace

import torch
from torch import Tensor

from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.candidates import BASELINE_PART
from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.certificate.statistics.estimate import CONFIDENCE, Estimate
from ocp_torch.control.policies import Policy
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import fits

MUCH = 0.01  # part of the discounted time above which a warning is due
TOLERANCE = 2e-3  # of that part for one trajectory, unless costs have a larger one
FEWEST_TRAJECTORIES = 8  # of a set: fewer leave an interval as wide as the part itself
VARIATE = 1.05  # a constant, near the clock's rate in the box, so that the weights of the starts add little noise


class _Free(PowerCost):
    """Control at no cost."""

    def cost(self, u: Tensor) -> Tensor:
        return torch.zeros_like(u[:, 0])


def _clock(problem: System) -> System:
    """``problem`` with a cost of 1 in the box and of 2 outside: a simulation of what it costs is one of where it is."""
    fits(problem)  # computed once for both: the clock starts where the problem does
    clock = copy.copy(problem)
    clock.control_cost = _Free(problem.exponent)
    vars(clock)["state_cost"] = lambda x: torch.where(problem.outside(x), 2.0, 1.0).to(x)
    return clock


def time_outside(problem: Problem, policy: Policy, settings: CertificateSettings, seed: int) -> Estimate | None:
    """`E[rho int e^{-rho t} 1[x_t is outside the box] dt]` along the closed loop of ``policy``; `None` where there is no box
    or too little is simulated."""
    few = settings.trajectories // BASELINE_PART
    if not isinstance(problem, System) or not problem.chart.boxed or few < FEWEST_TRAJECTORIES:
        return None
    found = Simulation(
        _clock(problem),
        policy,
        trajectories=few,
        replicates=settings.replicates,
        seed=seed,
        value=lambda x: torch.full_like(x[:, 0], VARIATE),
        initial=[VARIATE],
        horizon=settings.horizon,
        tolerance=max(TOLERANCE, settings.tolerance),
    ).run()
    return replace(found.perf, value=max(0.0, found.perf.value - 1.0))


def outside_note(problem: Problem, found: Estimate | None) -> list[str]:
    """The warning that more than `MUCH` of the time is, or may be, spent outside; empty if neither."""
    if found is None or not found.above > MUCH:
        return []
    assert isinstance(problem, System)
    names = " and ".join(problem.coordinates[i].name for i in problem.chart.boxed)
    where = f"of the discounted time outside the box of {names}, where the model is not yours"
    part, half = 100.0 * found.value, 100.0 * min(found.half_width(CONFIDENCE), 1.0)
    if found.value > MUCH:
        return [f"the controller spends {part:.2g} % (+- {half:.3g}) {where}: widen the box, or raise failure_cost."]
    return [
        f"the controller may spend up to {100.0 * found.above:.2g} % {where}, though {part:.2g} % was seen: raise "
        "certificate.trajectories to know, or widen the box."
    ]
