"""Which of the controllers is simulated how long: all of them shortly, and the better ones at length."""

import math
from functools import partial
from typing import NamedTuple

from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.performance import Simulated, Simulation
from ocp_torch.certificate.statistics.estimate import CONFIDENCE, Estimate
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.maths.jets import Field
from ocp_torch.problems.problem import Problem

# Divisor of the trajectories of rough simulations: of doing nothing, whose performance is a yardstick and no bound, and of a
# controller that another one clearly beats.
BASELINE_PART = 4
# Without noise so few trajectories in all take hardly longer than a part of them, and none is simulated roughly first.
CHEAP = 256
ROUGH_FACTOR = 200.0  # on the tolerance of rough simulations
ROUGH_DOUBLINGS = 1  # of their steps at most: four, as elsewhere, took 3.5 minutes for a controller that trembled
# Factor on the starts of a held control without noise: on a pendulum with limited torque the standard error fell from
# .004 to .006 to .002 to .003, in 45 s instead of 36.
MORE_HELD = 2


class Candidate(NamedTuple):
    """A controller to simulate, the control variate `V` of its simulation, and `E[V mu0]` per set; ``rounded`` are controller
    and `V` in single precision if they are networks of this package (see `Fields.rounded`)."""

    policy: Policy
    value: Field | None
    initial: list[float] | None
    rounded: tuple[Policy, Field | None] | None = None


def simulate_candidates(
    problem: Problem,
    candidates: dict[str, Candidate],
    settings: CertificateSettings,
    seed: int,
    best_only: bool,
    remembered: dict[str, Simulated] | None = None,
    chosen: str | None = None,
) -> tuple[dict[str, Simulated], Estimate]:
    """Performance of each of ``candidates``, and of doing nothing; what is ``remembered`` is not simulated again.

    With ``best_only``, where that saves time, candidates are simulated roughly first, on a quarter of the trajectories: the
    one that is ``chosen`` already, the best of the others and any that may still be better get all of them. Beside one that
    holds its control any that looks worse stays rough: acting at every instant it trembles where that one jumps, and would
    take minutes on fine steps."""

    simulate = partial(_simulated, problem, settings, seed)
    held = [name for name, candidate in candidates.items() if isinstance(candidate.policy, HeldPolicy)]
    many = problem.noisy or held or settings.trajectories * settings.replicates > CHEAP
    roughly_first = [name for name in candidates if name not in held and name != chosen]
    quickly = roughly_first if best_only and len(candidates) > 1 and many else []
    found = dict(remembered or {})
    found |= {name: simulate(c, name in quickly) for name, c in candidates.items() if name not in found}
    best = min((s.perf.above for s in found.values() if s.perf.finite), default=math.inf)
    lowest = math.inf  # performance of those simulated on all trajectories
    for name in sorted(quickly, key=lambda name: found[name].perf.value if found[name].perf.finite else math.inf):
        perf = found[name].perf
        if not (perf.above if held else perf.interval(CONFIDENCE)[0]) > best and not perf.value >= lowest:
            found[name] = simulate(candidates[name])
            lowest = min(lowest, found[name].perf.value)
    nothing = zero_policy(problem)  # the same in any precision
    return found, simulate(Candidate(nothing, None, None, (nothing, None)), roughly=True).perf


def _simulated(
    problem: Problem, settings: CertificateSettings, seed: int, candidate: Candidate, roughly: bool = False
) -> Simulated:
    """The performance of ``candidate``; ``roughly`` on a part of the trajectories, with large steps."""
    effort, tolerance, doublings = settings.trajectories, settings.tolerance, settings.doublings
    if isinstance(candidate.policy, HeldPolicy) and not problem.noisy:
        effort *= MORE_HELD
    if roughly:
        effort, tolerance, doublings = max(2, effort // BASELINE_PART), ROUGH_FACTOR * tolerance, ROUGH_DOUBLINGS
    return Simulation(
        problem,
        candidate.policy,
        trajectories=effort,
        replicates=settings.replicates,
        seed=seed,
        value=candidate.value,
        initial=candidate.initial,
        horizon=settings.horizon,
        tolerance=tolerance,
        rounded=candidate.rounded,
        doublings=doublings,
        audited=settings.audited,
    ).run()
