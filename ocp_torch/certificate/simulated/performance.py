r"""`Perf(u) = E_{x0 ~ mu0} rho int e^{-rho t} (f + R(u)) dt` by simulation, with `V` as control variate where there is one.

The infinite horizon is truncated, with the tail bounded; or each trajectory stops at a time `T ~ Exp(rho)` of its own,
and `E[rate(x_T)]` is the discounted integral, without a tail.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.settings import RANDOM, TRUNCATED, CertificateSettings
from ocp_torch.certificate.simulated.loops import HeldLoop, Loop, loop_of
from ocp_torch.certificate.simulated.paths import Paths
from ocp_torch.certificate.simulated.steps import Steps
from ocp_torch.certificate.simulated.unseen import (
    SIMULATION_REPLICATE,
    UNSEEN_ROOM,
    largest_rate_of,
    stratum_error,
    unmet_cost,
    unmet_tail,
    unseen_cost,
)
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.certificate.statistics.tails import widened
from ocp_torch.control.policies import Policy
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import MAX_DOUBLINGS
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import initial_points

# The truncated tail relative to the answer: the discount that is left times the rate's supremum.
TAIL_PART = 0.04  # of the tolerance
SMALLEST_TAIL = 2e-5  # whatever the tolerance: it rules up to 5e-4, that of a quick evaluation
LARGEST_TAIL = 0.02
LEAST_SIZE = 0.1  # of the answer, as a part of the mean state cost at the starts
# Mean error of the rates of single-precision networks at the starts, at most, as a part of the error allowed to a path's
# steps: on the circle and on dubins it is 2e-7 of the answer, a twenty-fifth of this at the default tolerance.
ROUNDING_PART = 0.1
# A `V` whose mean slack at the starts is above this part of the running cost is no control variate, as it changes faster than
# the cost: a quadrotor's from values of trajectories, at 2, asked for 15,000 steps where the cost asks for 800.
NO_VARIATE = 0.5
# First steps of all paths at most: where a small discount asks for more, fewer paths are followed by the cost itself, each so
# long that it sees most of what others do. A quadrotor's are 1.6e6.
MOST_STEPS = 2.0e6
FEWEST_PATHS = 4  # of each set even then
# Head-room on the rate's supremum, met at starts and ends, for the states after the end.
RATE_ROOM = 2.0


@dataclass(frozen=True)
class Simulated:
    """A performance, and what the trajectories showed: the largest value at a start, from below where there is noise, and
    the end states."""

    perf: Estimate
    largest_value: float | None
    end_states: Tensor
    jumped_over: str = ""  # the wall that steps jump over, in words; empty where none was seen
    unmet: float = 0.0  # what states far costlier than any that was met add, if one path comes to them
    rough: bool = False  # whether a simulation on more trajectories may follow


class Start(NamedTuple):
    """All paths at their starts ``x`` ``(N, d)``, one replicate after the other: the ``mass`` ``(N,)`` of `mu0` that each
    stands for, the ``times`` ``(N,)`` of their ends where these are random, the control variate ``base`` ``(N,)`` there, and
    the ``state`` of the loop, its ``velocity`` ``(N, d)`` and its ``rates``, ``(N,)`` or more columns of them."""

    x: Tensor
    mass: Tensor
    times: Tensor | None
    base: Tensor
    state: Tensor
    velocity: Tensor
    rates: Tensor

    @property
    def rate(self) -> Tensor:
        """The first column of the rates, ``(N,)``."""
        return self.rates.reshape(len(self.x), -1)[:, 0]


def starting_points(
    problem: Problem, trajectories: int, replicates: int, seed: int, extra: int = 0
) -> tuple[Tensor, Tensor]:
    """The starts of all replicates, one after the other, ``(replicates * trajectories, d + extra)``, and the mass of `mu0`
    that each stands for (see `initial_points`)."""
    sets = [initial_points(problem, trajectories, SIMULATION_REPLICATE + r, seed, extra) for r in range(replicates)]
    return torch.cat([x for x, _ in sets]), torch.cat([mass for _, mass in sets])


@dataclass(frozen=True, eq=False)
class Simulation:
    """Perf of ``policy`` from ``replicates`` independent sets of ``trajectories`` randomised Sobol starts, near `mu0`.

    With ``value`` its Bellman slack is simulated and ``initial``, `E[V mu0]` per replicate from many more states, is added.
    The cost itself is simulated where the slack is too large (`NO_VARIATE`), and along fewer paths where these are long
    (`MOST_STEPS`). Steps are halved, without noise ``doublings`` times at most, until a trajectory changes by less than
    ``tolerance``, relative to the answer, or all of them by little beside the standard error. ``rounded``, the controller
    and `V` in single precision, takes their place where both agree at the starts; a few trajectories are exact, and their
    differences go into the bias, unless, without noise, they are not ``audited``. A `HeldPolicy` renews its control at the
    times it is meant to, always up to a truncated ``horizon``.
    """

    problem: Problem
    policy: Policy
    trajectories: int
    replicates: int
    seed: int
    value: Field | None = None
    initial: list[float] | None = None
    horizon: str = TRUNCATED
    tolerance: float = CertificateSettings.tolerance
    rounded: tuple[Policy, Field | None] | None = None
    doublings: int = MAX_DOUBLINGS
    audited: bool = True

    @torch.no_grad()
    def run(self) -> Simulated:
        """The performance, by the cost itself along fewer paths where that is better."""
        if not self._is_variate:
            return self._without_value(self.trajectories).run()
        if not bool(torch.isfinite(self._start.velocity).all() and torch.isfinite(self._start.rate).all()):
            return Simulated(Estimate(math.nan, math.nan), math.nan, self._start.x)
        steps = self._steps
        fewer = max(FEWEST_PATHS, 2 ** int(math.log2(max(MOST_STEPS / (steps.count * self.replicates), 1.0))))
        if fewer < self.trajectories and not self._held:
            return self._without_value(fewer).run()
        return self._judged(self._paths(steps))

    def _without_value(self, trajectories: int) -> "Simulation":
        """This simulation by the cost itself, along ``trajectories`` of each set."""
        rounded = None if self.rounded is None else (self.rounded[0], None)
        return replace(self, trajectories=trajectories, value=None, initial=None, rounded=rounded)

    @cached_property
    def _loop(self) -> Loop:
        return loop_of(self.problem, self.policy, self.value)

    @property
    def _held(self) -> bool:
        return isinstance(self._loop, HeldLoop)

    @property
    def _along(self) -> Field | None:
        """The control variate of rates; `None` where a control is held, whose variate is of whole pieces."""
        return None if self._held else self.value

    @property
    def _ends_at_random(self) -> bool:
        return self.horizon == RANDOM and not self._held

    @cached_property
    def _start(self) -> "Start":
        """All paths at their starts."""
        dim, at_random = self.problem.dim, self._ends_at_random
        points, mass = starting_points(
            self.problem, self.trajectories, self.replicates, self.seed, extra=int(at_random)
        )
        x, loop = points[:, :dim], self._loop
        times = -torch.log1p(-points[:, dim]) / self.problem.discount if at_random else None
        base = torch.zeros_like(mass) if self._along is None else self._along(x)
        state = loop.start(x)
        velocity, rates = loop(state)
        return Start(x, mass, times, base, state, velocity[:, :dim], rates)

    @property
    def _is_variate(self) -> bool:
        """Whether the slack of the control variate is small enough at the starts, if there is one."""
        if self._along is None:
            return True
        start = self._start
        paid = loop_of(self.problem, self.policy, None)(start.state)[1]
        slack, cost = float((start.mass * start.rate).abs().mean()), float((start.mass * paid).mean())
        return slack <= NO_VARIATE * cost

    @cached_property
    def _size(self) -> float:
        """The size of the answer: the mean of `V - Q_u = f + R(u) + grad V . g / rho`, also where `E[V mu0]` is far off, and
        at least `LEAST_SIZE` of the mean state cost."""
        start = self._start
        least = LEAST_SIZE * float((start.mass * self.problem.state_cost(start.x)).mean())
        return max(float((start.mass * (start.base + start.rate)).mean().abs()), least, 1e-12)

    @property
    def _steps(self) -> Steps:
        start, rate = self._start, RATE_ROOM * float(self._start.rate.abs().max())
        if start.times is not None:
            return Steps.of(self._loop, float(start.times.max()), start.velocity)
        tail = min(max(TAIL_PART * self.tolerance, SMALLEST_TAIL), LARGEST_TAIL)
        to_the_tail = max(math.log(max(rate / (tail * self._size), math.e)), 1.0) / self.problem.discount
        return Steps.of(self._loop, to_the_tail, start.velocity)

    def _paths(self, steps: Steps) -> Paths:
        """The paths, in single precision where its rates at the starts differ little from the exact ones."""
        start, loop, allowed = self._start, self._loop, self.tolerance * self._size
        quick = loop if self.rounded is None else loop_of(self.problem, *self.rounded)
        off = float((quick(quick.renewed(start.state))[1] - start.rates).abs().mean())
        return Paths(
            loop,
            quick if off <= ROUNDING_PART * allowed else loop,
            steps,
            start.state,
            start.mass,
            self.replicates,
            times=start.times,
            allowed=allowed,
            seed=self.seed,
            together=self.rounded is not None and self.problem.concurrent,  # networks of ours are pure functions
            doublings=self.doublings,
            audited=self.audited,
            rounding=off,
            value=self.value if self._held else None,
        )

    def _judged(self, paths: Paths) -> Simulated:
        """What ``paths`` show. The bias is the error of integration (`refined`, with noise `Multilevel`), plus, where the
        horizon is truncated, the discount left there times the rate's supremum as met along the trajectories, with
        head-room; what states that no random path met may add; what is left of a mean that has no variance (`unmet_tail`);
        and all that any state may cost, where an audit shows a wall that the steps jump over (`jumped_over`)."""
        problem, start, replicates = self.problem, self._start, self.replicates
        result, end, refinement, bias, wall = paths.followed()
        ended = end[:, : problem.dim].remainder(1.0)
        if start.times is None:
            left = 0.0 if paths.value is None else paths.value(ended).abs()
            rates = float(start.rate.abs().max()), float((paths.rates(end).abs() + left).max())
            largest = RATE_ROOM * max(rates)
            bias += math.exp(-problem.discount * paths.steps.horizon) * largest * float(start.mass.mean())
        bias += UNSEEN_ROOM * unseen_cost(problem, start.x, start.mass, self.seed)
        bias += largest_rate_of(loop_of(problem, self.policy, None)) if wall else 0.0
        # Without noise evenly spread starts give evenly spread paths.
        chance = problem.noisy or self._ends_at_random
        met = float((start.mass * torch.maximum(start.rate.abs(), result.abs())).max())
        rare = unmet_cost(paths.quick, met, len(start.mass), self._size) if chance or self.audited else 0.0
        bias += rare if chance else 0.0
        parts, initial = (paths.means(result) + refinement).tolist(), self.initial
        totals = [part + (initial[r % len(initial)] if initial else 0.0) for r, part in enumerate(parts)]
        bias += unmet_tail(paths, result, self._size)
        perf = Estimate.of(totals, bias=bias)
        weighted = start.mass * result
        perf = widened(replace(perf, se=max(perf.se, stratum_error(weighted, replicates))), [weighted])
        # With noise a path scatters about its mean `V^u`, the largest of `N` by some `sqrt(2 log N)` standard deviations.
        above = float(result.std()) * math.sqrt(2.0 * math.log(len(result))) if problem.noisy else 0.0
        highest = None if self._ends_at_random or self._held else float((start.base + result).max()) - above
        return Simulated(perf, highest, ended, wall, 0.0 if chance else rare)
