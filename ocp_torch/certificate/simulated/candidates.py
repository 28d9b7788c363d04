"""Which of the controllers is simulated how long: all of them shortly, and the better ones at length."""

import math
from typing import NamedTuple

from ocp_torch.certificate.estimate import CONFIDENCE, Estimate
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.performance import Simulated, simulate_performance
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.maths.jets import Field
from ocp_torch.problems.problem import Problem

# Doing nothing has no control variate; its performance is a yardstick, not a bound, and needs few trajectories. So does
# a controller that another one clearly beats; but without noise so few in all as the second number take hardly longer than a
# part of them (with noise the finest steps take longest: 2.2 s for the worse controller of a pendulum in a look of 5.3 s).
# Their steps need not be as fine either: the third is by how many times. Where one controller holds its control, another one
# that acts at every instant often trembles at the same ridges, and takes minutes on fine steps.
BASELINE_PART, CHEAP, ROUGH = 4, 256, 200.0


class Candidate(NamedTuple):
    """A controller to simulate, the control variate `V` of its simulation, and `E[V mu0]` per set; and, if the first two are
    networks of this package, what these are in single precision (see `Fields.rounded`)."""

    policy: Policy
    value: Field | None
    initial: list[float] | None
    rounded: tuple[Policy, Field | None] | None = None


def simulate_candidates(
    problem: Problem, candidates: dict[str, Candidate], settings: CertificateSettings, seed: int, best_only: bool
) -> tuple[dict[str, Simulated], Estimate]:
    """Performance of each of ``candidates``, and of doing nothing. With ``best_only`` one that is clearly worse than another
    on a quarter of the trajectories gets no more of them, where that saves time."""

    def simulate(candidate: Candidate, trajectories: int, room: float = 1.0) -> Simulated:
        policy, value, initial, rounded = candidate
        effort, how = (trajectories, settings.replicates, seed), (settings.horizon, room * settings.tolerance, rounded)
        return simulate_performance(problem, policy, *effort, value, initial, *how)

    few = max(2, settings.trajectories // BASELINE_PART)
    held = any(isinstance(candidate.policy, HeldPolicy) for candidate in candidates.values())
    many = problem.noisy or held or settings.trajectories * settings.replicates > CHEAP
    pays = best_only and len(candidates) > 1 and many
    found = {name: simulate(candidate, few, ROUGH) for name, candidate in candidates.items()} if pays else {}
    best = min((s.perf.above for s in found.values() if s.perf.finite), default=math.inf)
    for name, candidate in candidates.items():
        if name not in found or not found[name].perf.interval(CONFIDENCE)[0] > best:
            found[name] = simulate(candidate, settings.trajectories)
    nothing = zero_policy(problem)  # the same in any precision
    return found, simulate(Candidate(nothing, None, None, (nothing, None)), few, ROUGH).perf
