"""What each of several controllers costs, and doing nothing, where only the best of them is handed out."""

from __future__ import annotations

import math
from functools import partial

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


def simulate_candidates(
    problem: Problem,
    policies: dict[str, Policy],
    value: Field | None,
    initial: list[float] | None,
    settings: CertificateSettings,
    seed: int,
) -> tuple[dict[str, Simulated], Estimate]:
    """Performance of each of ``policies``, with ``value`` as control variate, and of doing nothing.

    ``initial`` is `E[V mu0]` per set. A policy that is clearly worse than another on a quarter of the trajectories gets no
    more of them, where that saves time.
    """
    simulate = partial(
        simulate_performance,
        problem,
        replicates=settings.replicates,
        seed=seed,
        horizon=settings.horizon,
        tolerance=settings.tolerance,
    )
    few = few_trajectories(settings)
    judge = lambda policy, trajectories: simulate(policy, trajectories=trajectories, value=value, initial=initial)
    pays = len(policies) > 1 and settings.trajectories * settings.replicates > CHEAP
    found = {name: judge(policy, few) for name, policy in policies.items()} if pays else {}
    best = min((s.perf.above for s in found.values() if s.perf.finite), default=math.inf)
    for name, policy in policies.items():
        if name not in found or not found[name].perf.below > best:
            found[name] = judge(policy, settings.trajectories)
    return found, simulate(zero_policy(problem), trajectories=few).perf


def few_trajectories(settings: CertificateSettings) -> int:
    """Trajectories per replicate for what needs few."""
    return max(2, settings.trajectories // BASELINE_PART)
