"""Which of the controllers is simulated how long: all of them shortly, and the better ones at length."""

import math
from dataclasses import replace
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


def first_look(
    problem: Problem,
    candidates: dict[str, Candidate],
    settings: CertificateSettings,
    seed: int,
    best_only: bool,
    remembered: dict[str, Simulated] | None = None,
    expected: str | None = None,
) -> dict[str, Simulated]:
    """Each of ``candidates`` simulated, or ``remembered``; with ``best_only``, where that saves time, roughly, on a quarter
    of the trajectories, but the one that is ``expected`` to be the best and those that hold their control."""
    many = problem.noisy or _held(candidates) or settings.trajectories * settings.replicates > CHEAP
    exact = {expected, *_held(candidates)} if best_only and len(candidates) > 1 and many else candidates.keys()
    known = {name: found for name, found in (remembered or {}).items() if not (found.rough and name in exact)}
    simulate = partial(_simulated, problem, settings, seed)
    return known | {name: simulate(c, name not in exact) for name, c in candidates.items() if name not in known}


def simulate_candidates(
    problem: Problem,
    candidates: dict[str, Candidate],
    settings: CertificateSettings,
    seed: int,
    looked: dict[str, Simulated],
) -> tuple[dict[str, Simulated], Estimate]:
    """Performance of each of ``candidates``, and of doing nothing: of those that a `first_look` ``looked`` at roughly the
    best, and any that may still be better, get all trajectories. Beside one that holds its control any that looks worse
    stays rough: acting at every instant it trembles where that one jumps, and would take minutes on fine steps."""
    simulate, held, found = partial(_simulated, problem, settings, seed), _held(candidates), dict(looked)
    rough = [name for name in found if found[name].rough]
    best = min((s.perf.above for s in found.values() if s.perf.finite), default=math.inf)
    lowest = math.inf  # performance of those simulated on all trajectories
    for name in sorted(rough, key=lambda name: found[name].perf.value if found[name].perf.finite else math.inf):
        perf = found[name].perf
        if not (perf.above if held else perf.interval(CONFIDENCE)[0]) > best and not perf.value >= lowest:
            found[name] = simulate(candidates[name])
            lowest = min(lowest, found[name].perf.value)
    nothing = zero_policy(problem)  # the same in any precision
    return found, simulate(Candidate(nothing, None, None, (nothing, None)), roughly=True).perf


def _held(candidates: dict[str, Candidate]) -> list[str]:
    """Those of ``candidates`` that hold their control."""
    return [name for name, candidate in candidates.items() if isinstance(candidate.policy, HeldPolicy)]


def _simulated(
    problem: Problem, settings: CertificateSettings, seed: int, candidate: Candidate, roughly: bool = False
) -> Simulated:
    """The performance of ``candidate``; ``roughly`` on a part of the trajectories, with large steps."""
    effort, tolerance, doublings = settings.trajectories, settings.tolerance, settings.doublings
    if isinstance(candidate.policy, HeldPolicy) and not problem.noisy:
        effort *= MORE_HELD
    if roughly:
        effort, tolerance, doublings = max(2, effort // BASELINE_PART), ROUGH_FACTOR * tolerance, ROUGH_DOUBLINGS
    simulation = Simulation(
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
    )
    return replace(simulation.run(), rough=roughly)
