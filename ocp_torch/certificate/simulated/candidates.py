"""Which of the controllers is simulated how long: all of them shortly, and the better ones at length."""

import math
from typing import NamedTuple

from ocp_torch.certificate.estimate import CONFIDENCE, Estimate
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.performance import Simulated, Simulation
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import MAX_DOUBLINGS
from ocp_torch.problems.problem import Problem

# Doing nothing has no control variate; its performance is a yardstick, not a bound, and needs few trajectories. So does
# a controller that another one clearly beats; but without noise so few in all as the second number take hardly longer than a
# part of them (with noise the finest steps take longest: 2.2 of 5.3 s of a quick evaluation for the worse controller of a
# pendulum). Their steps need not be as fine either: the third is by how many times, and the last how often they are halved at
# most (four times as elsewhere took 3.5 minutes for a controller that trembled, and cost 40 % more than the best).
BASELINE_PART, CHEAP, ROUGH, HALVED = 4, 256, 200.0, 1
# Without noise a controller that holds its control is simulated from so many times as many starts: 512 in each of 8 sets took
# 45 s for 36 on a pendulum with limited torque, and the standard error fell from .004 to .006 to .002 to .003.
MORE_HELD = 2


class Candidate(NamedTuple):
    """A controller to simulate, the control variate `V` of its simulation, and `E[V mu0]` per set; and, if the first two are
    networks of this package, what these are in single precision (see `Fields.rounded`)."""

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
    """Performance of each of ``candidates``, and of doing nothing. With ``best_only``, and where that saves time, only the
    one that is best on a quarter of the trajectories gets all of them, and one that then still looks better; and the one
    that is ``chosen`` already. Beside one that holds its control, and takes as long for a few trajectories, any worse one is
    left at that: acting at every instant it trembles where the other jumps, and would take minutes on fine steps. What is
    ``remembered`` is not simulated again."""

    def simulate(candidate: Candidate, roughly: bool = False) -> Simulated:
        policy, value, initial, rounded = candidate
        effort, tolerance, doublings = settings.trajectories, settings.tolerance, MAX_DOUBLINGS
        if isinstance(policy, HeldPolicy) and not problem.noisy:
            effort *= MORE_HELD
        if roughly:
            effort, tolerance, doublings = max(2, effort // BASELINE_PART), ROUGH * tolerance, HALVED
        sets, how = (settings.replicates, seed, value, initial), (settings.horizon, tolerance, rounded, doublings)
        return Simulation(problem, policy, effort, *sets, *how, settings.audited).run()

    held = [name for name, candidate in candidates.items() if isinstance(candidate.policy, HeldPolicy)]
    many = problem.noisy or held or settings.trajectories * settings.replicates > CHEAP
    roughly_first = [name for name in candidates if name not in held and name != chosen]
    quickly = roughly_first if best_only and len(candidates) > 1 and many else []
    found = dict(remembered or {})
    found |= {name: simulate(c, name in quickly) for name, c in candidates.items() if name not in found}
    best = min((s.perf.above for s in found.values() if s.perf.finite), default=math.inf)
    lowest = math.inf  # of those that were simulated at length
    for name in sorted(quickly, key=lambda name: found[name].perf.value if found[name].perf.finite else math.inf):
        perf = found[name].perf
        if not (perf.above if held else perf.interval(CONFIDENCE)[0]) > best and not perf.value >= lowest:
            found[name] = simulate(candidates[name])
            lowest = min(lowest, found[name].perf.value)
    nothing = zero_policy(problem)  # the same in any precision
    return found, simulate(Candidate(nothing, None, None, (nothing, None)), roughly=True).perf
