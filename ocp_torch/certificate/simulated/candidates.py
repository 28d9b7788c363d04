"""What each of several controllers costs, and doing nothing."""

import math
from typing import NamedTuple

from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.performance import Simulated, simulate_performance
from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.maths.jets import Field
from ocp_torch.problems.problem import Problem

# Doing nothing has no control variate; its performance is a yardstick, not a bound, and needs few trajectories. So does
# a controller that another one clearly beats.
BASELINE_PART = 4
# But so few trajectories take hardly longer than a part of them.
CHEAP = 256


class Candidate(NamedTuple):
    """A controller to simulate, the control variate `V` of its simulation, and `E[V mu0]` per set."""

    policy: Policy
    value: Field | None
    initial: list[float] | None


def simulate_candidates(
    problem: Problem, candidates: dict[str, Candidate], settings: CertificateSettings, seed: int, best_only: bool
) -> tuple[dict[str, Simulated], Estimate]:
    """Performance of each of ``candidates``, and of doing nothing. With ``best_only`` one that is clearly worse than another
    on a quarter of the trajectories gets no more of them, where that saves time."""
    simulate = lambda candidate, trajectories: simulate_performance(
        problem,
        candidate.policy,
        trajectories,
        settings.replicates,
        seed,
        candidate.value,
        candidate.initial,
        settings.horizon,
        settings.tolerance,
    )
    few = max(2, settings.trajectories // BASELINE_PART)
    pays = best_only and len(candidates) > 1 and settings.trajectories * settings.replicates > CHEAP
    found = {name: simulate(candidate, few) for name, candidate in candidates.items()} if pays else {}
    best = min((s.perf.above for s in found.values() if s.perf.finite), default=math.inf)
    for name, candidate in candidates.items():
        if name not in found or not found[name].perf.below > best:
            found[name] = simulate(candidate, settings.trajectories)
    return found, simulate(Candidate(zero_policy(problem), None, None), few).perf
