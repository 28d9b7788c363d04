r"""`Perf(u) = E_{x0 ~ mu0} rho int e^{-rho t} (f + R(u)) dt` by simulation, with `V` as control variate where there is one.

The infinite horizon is truncated, with the tail bounded; or each trajectory stops at a time `T ~ Exp(rho)` of its own,
and `E[rate(x_T)]` is the discounted integral, without a tail.
"""

import math
from dataclasses import dataclass, replace
from typing import cast

import torch
from torch import Tensor

from ocp_torch.certificate.checks.tails import beyond_largest, widened
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.settings import RANDOM, TRUNCATED, CertificateSettings
from ocp_torch.certificate.simulated.between import jumped_over
from ocp_torch.certificate.simulated.held import held_integrals
from ocp_torch.certificate.simulated.loops import FeedbackLoop, HeldLoop, Sliding, loop_of
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
from ocp_torch.maths.brownian import Grid, at_random_times, discounted, expectation
from ocp_torch.maths.cores import in_pieces
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import (
    AUDITED,
    MAX_DOUBLINGS,
    Dynamics,
    Integrate,
    discounted_integral,
    in_finer_steps,
    rate_at,
    refined,
)
from ocp_torch.maths.seeds import Branch, derive_seed
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
# How many times as many steps are taken, once, where others jump over a wall: one a hundredth of a turn thick is met then;
# and how often these are halved at most, for steps that are as fine as elsewhere in the end.
FINER, LEFT = 8, MAX_DOUBLINGS - 3
# Where the first steps of all paths are more than that, as with a small discount, fewer paths are taken, but so many in each
# set, and the cost itself along them: each is so long that it sees most of what others do. A quadrotor's are 1.6e6.
MOST_STEPS, LEAST_PATHS = 2.0e6, 4
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
    (`beyond_largest`); and all that any state may cost, where an audit shows a wall that the steps jump over
    (`jumped_over`). A `HeldPolicy` is simulated as one: its control changes only when it is renewed, always up to a
    truncated horizon.
    """
    dim, rho = problem.dim, problem.discount
    dynamics = loop_of(problem, policy, value)
    random = horizon == RANDOM and not isinstance(dynamics, HeldLoop)
    points, mass = starting_points(problem, trajectories, replicates, seed, extra=int(random))
    x0 = points[:, :dim]
    plain = None if rounded is None else (rounded[0], None)
    plainly = lambda count: simulate_performance(
        problem, policy, count, replicates, seed, None, None, horizon, tolerance, plain, doublings, audited
    )
    along, beside = (None, value) if isinstance(dynamics, HeldLoop) else (value, None)  # of rates; of whole pieces
    with torch.no_grad():
        base = along(x0) if along is not None else torch.zeros_like(x0[:, 0])
        state = dynamics.start(x0)
        velocity, rate = dynamics(state)
        if along is not None:
            paid = loop_of(problem, policy, None)(state)[1]
            if not float((mass * rate.reshape(len(x0), -1)[:, 0]).abs().mean()) <= NO_VARIATE * float(
                (mass * paid).mean()
            ):
                return plainly(trajectories)
        quick = dynamics if rounded is None else loop_of(problem, *rounded)
        off = (quick(quick.renewed(state))[1] - rate).abs().mean()
        velocity, rate = velocity[:, :dim], rate.reshape(len(x0), -1)[:, 0]
        met = (mass * rate).abs()  # of starts that carry no mass nothing counts
    if not (torch.isfinite(velocity).all() and torch.isfinite(rate).all()):
        return Simulated(Estimate(math.nan, math.nan), math.nan, x0)
    # By the slack's definition `V - Q_u = f + R(u) + grad V . g / rho`: the answer's size also where `E[V mu0]` is far off.
    size = max(float((mass * (base + rate)).mean().abs()), LEAST * float((mass * problem.state_cost(x0)).mean()), 1e-12)
    largest_rate = RATE_ROOM * float(rate.abs().max())
    quick = quick if float(off) <= ROUNDED * tolerance * size else dynamics
    together = rounded is not None and problem.concurrent  # networks of ours are pure functions
    times = -torch.log1p(-points[:, dim]) / rho if random else torch.zeros_like(mass)
    tail = min(max(TAIL_PART * tolerance, SMALLEST_TAIL), LARGEST_TAIL)
    longest = float(times.max()) if random else max(math.log(max(largest_rate / (tail * size), math.e)), 1.0) / rho
    steps = Steps.of(dynamics, longest, velocity)
    fewer = max(LEAST_PATHS, 2 ** int(math.log2(max(MOST_STEPS / (steps.count * replicates), 1.0))))
    if fewer < trajectories and not isinstance(dynamics, HeldLoop):
        return plainly(fewer)
    sliding = Sliding(len(x0), tolerance * size) if isinstance(dynamics, FeedbackLoop) and dynamics.summed else None

    def integrated(by: Dynamics) -> Integrate:
        def some(rows: Tensor, count: int) -> tuple[Tensor, Tensor]:
            if random:
                return rate_at(by, state[rows], rho, times[rows], count, wrap=False)
            return discounted_integral(by, state[rows], rho, steps.horizon, count, wrap=False, grading=steps.grading)

        finer = in_finer_steps(some, steps.multiples)
        pieces = lambda rows, count: in_pieces(lambda n: finer(n, count), rows, together, long=True)
        all_rows = lambda rows, count: cast(tuple[Tensor, Tensor], pieces(rows, count))
        return all_rows if sliding is None else sliding.by(all_rows)

    swift, exact = steps.taken_by(quick), None if quick is dynamics else steps.taken_by(dynamics)
    means = lambda results: (mass * results).reshape(replicates, trajectories).mean(dim=1)
    generator = torch.Generator().manual_seed(derive_seed(seed, Branch.AUDIT))
    between = lambda taken: jumped_over(quick, steps, state, taken, seed) if audited else ""
    if problem.noisy:
        horizons, grading = (times, 1.0) if random else (torch.full_like(mass, steps.horizon), steps.grading)
        grid = Grid(horizons, steps.count, grading)
        how = at_random_times(rho) if random else discounted(rho), tolerance * size, seed
        found = expectation(swift, dynamics.noise, state, mass, replicates, grid, *how, exact, together)
        result, refinement, end, bias, finest = found
        wall = between(torch.full_like(mass, finest))
        result = result if beside is None else result - beside(x0)
    elif isinstance(dynamics, HeldLoop) and isinstance(quick, HeldLoop):
        loops, sets = (dynamics, quick, beside), (state, mass, replicates)
        result, end, bias = held_integrals(*loops, *sets, steps.horizon, tolerance * size, generator, together)
        refinement, wall = torch.zeros_like(means(result)), between(torch.full_like(mass, steps.count))
    else:
        error = lambda results: Estimate.of(means(results).tolist()).se
        audit = None if exact is None else integrated(exact)
        accuracy = tolerance * size, generator, error, audit, doublings, AUDITED if audited else 0
        result, end, bias, taken = refined(integrated(swift), mass, steps.count, *accuracy)
        if (wall := between(taken)) and doublings == MAX_DOUBLINGS:
            steps = replace(steps, count=FINER * steps.count)
            accuracy = tolerance * size, generator, error, audit, LEFT, AUDITED
            result, end, bias, taken = refined(integrated(swift), mass, steps.count, *accuracy)
            wall = between(taken)
        bias += 0.0 if audited or exact is None else float(off)  # rounding alone must not look like a contradiction
        refinement = torch.zeros_like(means(result))
    ended = end[:, :dim].remainder(1.0)
    with torch.no_grad():
        rate = dynamics(end)[1]
        rate = rate if sliding is None else sliding.corrected(rate, torch.arange(len(rate)))
        left = 0.0 if beside is None else beside(ended).abs()
        largest_rate = max(largest_rate, RATE_ROOM * float((rate.abs() + left).max()))
    if not random:
        bias += math.exp(-rho * steps.horizon) * largest_rate * float(mass.mean())
    bias += UNSEEN_ROOM * unseen_cost(problem, x0, mass, seed)
    bias += largest_rate_of(loop_of(problem, policy, None)) if wall else 0.0
    chance, met = problem.noisy or random, torch.maximum(met, (mass * result).abs())
    rare = unmet_cost(quick, float(met.max()), len(met), size) if chance or audited else 0.0
    bias += rare if chance else 0.0  # starts are spread evenly, and their paths follow from them
    parts = (means(result) + refinement).tolist()
    totals = [part + (initial[r % len(initial)] if initial else 0.0) for r, part in enumerate(parts)]
    bias += beyond_largest(result, mass, size)
    perf = Estimate.of(totals, bias=bias)
    perf = widened(replace(perf, se=max(perf.se, stratum_error(mass * result, replicates))), [mass * result])
    # One path with noise is off its mean, `V^u`; the largest of `N` by some `sqrt(2 log N)` standard deviations.
    above = float(result.std()) * math.sqrt(2.0 * math.log(len(result))) if problem.noisy else 0.0
    largest = None if random or isinstance(dynamics, HeldLoop) else float((base + result).max()) - above
    return Simulated(perf, largest, ended, wall, 0.0 if chance else rare)
