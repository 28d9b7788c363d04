r"""`Perf(u) = E_{x0 ~ mu0} rho int e^{-rho t} (f + R(u)) dt` by simulation, with `V` as control variate where there is one.

The infinite horizon is truncated, with the tail bounded; or each trajectory stops at a time `T ~ Exp(rho)` of its own,
and `E[rate(x_T)]` is the discounted integral, without a tail.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ocp_torch.certificate.checks.tails import beyond_largest, unmet, widened
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.settings import RANDOM, TRUNCATED, CertificateSettings
from ocp_torch.certificate.simulated.loops import HeldLoop, loop_of
from ocp_torch.certificate.simulated.paths import Paths
from ocp_torch.certificate.simulated.steps import Steps
from ocp_torch.certificate.simulated.unseen import (
    SIMULATION_REPLICATE,
    UNSEEN_ROOM,
    largest_rate_of,
    stratum_error,
    unmet_cost,
    unseen_cost,
)
from ocp_torch.control.policies import Policy
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import MAX_DOUBLINGS
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import initial_points

# What is left of the discount when simulation stops, times the rate's supremum, relative to the answer: that part of the
# tolerance, and so much at least and at most. At the tolerance of a quick evaluation, 5e-4, it is the least; only rough
# simulations stop earlier. The answer is taken to be at least the last part of the mean state cost at the starts.
TAIL_PART, SMALLEST_TAIL, LARGEST_TAIL, LEAST = 0.04, 2e-5, 0.02, 0.1
# How far the rates of networks in single precision may be off at the starts in the mean, as a part of what the steps of a
# trajectory may be off by: 2e-7 of the answer on the circle and on dubins, a twenty-fifth of this at the default tolerance.
ROUNDED = 0.1
# A `V` whose slack at the starts is, in the mean, more than that part of the running cost is no control variate: what it adds
# to the simulation changes faster than what it takes off. From values of trajectories it was .7 on a pendubot and 2 on a
# quadrotor, and asked for 15,000 steps where the cost asks for 800; .003 to .08 for `V` of `dual` and `pd`.
NO_VARIATE = 0.5
# Where the first steps of all paths are more than that, as with a small discount, fewer paths are taken, but so many in each
# set, and the cost itself along them: each is so long that it sees most of what others do. A quadrotor's are 1.6e6.
MOST_STEPS, LEAST_PATHS = 2.0e6, 4
# Ascents to the largest rate there is: one that has none, as `r^-1.6`, is then larger than all that could matter.
ASCENTS = 32
# Head-room on the rate's supremum, met at starts and ends, for the states after the end.
RATE_ROOM = 2.0


@dataclass(frozen=True)
class Simulated:
    """A performance, and what the trajectories showed: the largest value at a start, from below where there is noise, and
    the end states."""

    perf: Estimate
    largest_value: float | None
    end_states: Tensor
    jumped_over: str = ""  # what the steps cannot have seen, where there is anything
    unmet: float = 0.0  # what states far dearer than any that was met add, if one path comes to them


def starting_points(
    problem: Problem, trajectories: int, replicates: int, seed: int, extra: int = 0
) -> tuple[Tensor, Tensor]:
    """The starts of all replicates, one after the other, ``(replicates * trajectories, d + extra)``, and the mass of `mu0`
    that each stands for (see `initial_points`)."""
    sets = [initial_points(problem, trajectories, SIMULATION_REPLICATE + r, seed, extra) for r in range(replicates)]
    return torch.cat([x for x, _ in sets]), torch.cat([mass for _, mass in sets])


@torch.no_grad()
def simulate_performance(
    problem: Problem,
    policy: Policy,
    trajectories: int,
    replicates: int,
    seed: int,
    value: Field | None = None,
    initial: list[float] | None = None,
    horizon: str = TRUNCATED,
    tolerance: float = CertificateSettings.tolerance,
    rounded: tuple[Policy, Field | None] | None = None,
    doublings: int = MAX_DOUBLINGS,
    audited: bool = True,
) -> Simulated:
    """Perf of ``policy`` from ``replicates`` independent sets of ``trajectories`` randomised Sobol starts, near `mu0`.

    With ``value`` its Bellman slack is simulated and ``initial``, `E[V mu0]` per replicate from many more states, is added;
    unless the slack is so large that the cost itself is simulated with less effort, or paths are so long that this is done
    along fewer of them (`MOST_STEPS`). Steps are halved, without noise ``doublings`` times at most, until a trajectory
    changes by less than ``tolerance``, relative to the answer, or all of them by little beside the standard error.
    ``rounded``, the controller and `V` in single precision, takes their place where it agrees well enough with them at the
    starts; a few trajectories are exact, and what they differ by goes into the ``bias``, unless, without noise, they are
    not ``audited``. The ``bias`` is the error of integration (`refined`, with noise `expectation`), plus, where the
    ``horizon`` is truncated, the discount left there times the rate's supremum as met along the trajectories, with
    head-room, what states that no random path met may add, and what is left of a mean that has no variance
    (`_unmet_tail`); and all that any state may cost, where an audit shows a wall that the steps jump over
    (`jumped_over`). A `HeldPolicy` is simulated as one: its control changes only when it is renewed, always up to a
    truncated horizon.
    """
    dim, rho = problem.dim, problem.discount
    loop = loop_of(problem, policy, value)
    held = isinstance(loop, HeldLoop)
    random = horizon == RANDOM and not held
    points, mass = starting_points(problem, trajectories, replicates, seed, extra=int(random))
    x0, times = points[:, :dim], -torch.log1p(-points[:, dim]) / rho if random else None
    plain = None if rounded is None else (rounded[0], None)
    plainly = lambda count: simulate_performance(
        problem, policy, count, replicates, seed, None, None, horizon, tolerance, plain, doublings, audited
    )
    along, beside = (None, value) if held else (value, None)  # of rates; of whole pieces
    base = along(x0) if along is not None else torch.zeros_like(mass)
    state = loop.start(x0)
    velocity, rates = loop(state)
    velocity, rate = velocity[:, :dim], rates.reshape(len(x0), -1)[:, 0]
    if along is not None:
        paid = loop_of(problem, policy, None)(state)[1]
        if not float((mass * rate).abs().mean()) <= NO_VARIATE * float((mass * paid).mean()):
            return plainly(trajectories)
    quick = loop if rounded is None else loop_of(problem, *rounded)
    off = float((quick(quick.renewed(state))[1] - rates).abs().mean())
    if not (torch.isfinite(velocity).all() and torch.isfinite(rate).all()):
        return Simulated(Estimate(math.nan, math.nan), math.nan, x0)
    # By the slack's definition `V - Q_u = f + R(u) + grad V . g / rho`: the answer's size also where `E[V mu0]` is far off.
    size = max(float((mass * (base + rate)).mean().abs()), LEAST * float((mass * problem.state_cost(x0)).mean()), 1e-12)
    largest_rate = RATE_ROOM * float(rate.abs().max())
    tail = min(max(TAIL_PART * tolerance, SMALLEST_TAIL), LARGEST_TAIL)
    to_the_tail = max(math.log(max(largest_rate / (tail * size), math.e)), 1.0) / rho
    steps = Steps.of(loop, to_the_tail if times is None else float(times.max()), velocity)
    fewer = max(LEAST_PATHS, 2 ** int(math.log2(max(MOST_STEPS / (steps.count * replicates), 1.0))))
    if fewer < trajectories and not held:
        return plainly(fewer)
    allowed = tolerance * size
    paths = Paths(
        loop,
        quick if off <= ROUNDED * allowed else loop,
        steps,
        state,
        mass,
        replicates,
        times=times,
        allowed=allowed,
        seed=seed,
        together=rounded is not None and problem.concurrent,  # networks of ours are pure functions
        doublings=doublings,
        audited=audited,
        rounding=off,
        value=beside,
    )
    result, end, refinement, bias, wall = paths.followed()
    ended = end[:, :dim].remainder(1.0)
    if times is None:
        left = 0.0 if beside is None else beside(ended).abs()
        largest_rate = max(largest_rate, RATE_ROOM * float((paths.rates(end).abs() + left).max()))
        bias += math.exp(-rho * steps.horizon) * largest_rate * float(mass.mean())
    bias += UNSEEN_ROOM * unseen_cost(problem, x0, mass, seed)
    bias += largest_rate_of(loop_of(problem, policy, None)) if wall else 0.0
    # Starts are spread evenly, and without noise their paths follow from them.
    chance, met = problem.noisy or random, (mass * torch.maximum(rate.abs(), result.abs())).max()
    rare = unmet_cost(paths.quick, float(met), len(mass), size) if chance or audited else 0.0
    bias += rare if chance else 0.0
    parts = (paths.means(result) + refinement).tolist()
    totals = [part + (initial[r % len(initial)] if initial else 0.0) for r, part in enumerate(parts)]
    bias += _unmet_tail(paths, result, size)
    perf = Estimate.of(totals, bias=bias)
    perf = widened(replace(perf, se=max(perf.se, stratum_error(mass * result, replicates))), [mass * result])
    # One path with noise is off its mean, `V^u`; the largest of `N` by some `sqrt(2 log N)` standard deviations.
    above = float(result.std()) * math.sqrt(2.0 * math.log(len(result))) if problem.noisy else 0.0
    largest = None if random or held else float((base + result).max()) - above
    return Simulated(perf, largest, ended, wall, 0.0 if chance else rare)


def _unmet_tail(paths: Paths, results: Tensor, size: float) -> float:
    """What results larger than any of ``results`` ``(N,)`` of ``paths`` add to their mean, whose size is ``size``: by how the
    largest fall off, but no more than results as large as the largest rate that is found do, `3 / N` of all paths. Kinks of
    `V` leave errors that fall off slowly up to the largest slack: of a torus that was .1 % where the former alone was up to
    .6 %."""
    beyond = beyond_largest(results, paths.mass, size)
    if not beyond > 0.0:
        return 0.0
    largest = max(largest_rate_of(paths.quick, ASCENTS), float(results.abs().max()))
    largest += abs(float(paths.means(results).mean()))
    if paths.value is not None:
        largest += float(paths.value(paths.state[:, : paths.loop.problem.dim]).abs().max())
    return min(beyond, unmet(float(paths.mass.max()) * largest, len(results)))
