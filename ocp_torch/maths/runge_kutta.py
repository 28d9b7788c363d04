"""The closed loop in time: a fourth-order Runge-Kutta integrator for states and discounted costs along trajectories.

Steps are equal along a trajectory and the error is controlled by halving them (`refined`). The adaptive solvers of the
libraries choose one step for a whole batch, so that a single trajectory at a jump of its controller stalls the rest.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

# Maps states (N, d) to velocities (N, d) and rates (N,), or several (N, k), to be discounted and integrated along the way.
Dynamics = Callable[[Tensor], tuple[Tensor, Tensor]]
# Maps rows of the batch and a number of steps to a result per trajectory (n,) and their end states (n, d).
Integrate = Callable[[Tensor, int], tuple[Tensor, Tensor]]

MAX_DOUBLINGS = 4  # of the number of steps
SLOWEST_DECAY = 0.8  # of the changes by halvings, for the extrapolation of what is left
# Nothing is refined where the mean change is below this part of the tolerance, or of the answer's standard error, and below
# the tolerance itself, as the standard error of a few trajectories means little.
GOOD_PART = 0.1
# Halving also ends where trajectories still to be halved make less than this part of the mean change: else one of 2,048 on
# the circle took half of the time, for an error of 5.5e-7 in place of 5.8e-7.
RELEVANT_PART = 0.2
AUDITED = 64  # random trajectories that are integrated again
AUDIT_FACTOR = 4  # least factor by which their steps are then finer than at first


@dataclass(frozen=True)
class Switched:
    """``dynamics`` whose states jump ``count`` times, at time 0 and then evenly, to what ``renewed`` gives, as where a
    control is held in between."""

    dynamics: Dynamics
    renewed: Callable[[Tensor], Tensor]
    count: int

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self.dynamics(x)

    @staticmethod
    def before(dynamics: Dynamics, step: int, steps: int, x: Tensor) -> Tensor:
        """The state from which ``step`` of ``steps``, a multiple of the ``count``, is made; ``x`` where nothing jumps."""
        if not isinstance(dynamics, Switched) or step % (steps // dynamics.count):
            return x
        return dynamics.renewed(x)


@torch.no_grad()
def discounted_integral(
    dynamics: Dynamics, x0: Tensor, rho: float, horizon: float, steps: int, wrap: bool = True, grading: float = 1.0
) -> tuple[Tensor, Tensor]:
    r"""`int_0^T rho e^{-rho t} rate(x_t) dt` ``(N,)`` and the end states ``(N, d)``, by classical RK4 with equal steps of
    `s` in `[0, 1]`, where `t = T s^p` and `p` is the ``grading``: above 1 it makes early steps short and late ones long.

    Dynamics that are `Switched` jump at even times, and take a ``grading`` of 1. End states are wrapped to the unit cell
    unless ``wrap`` is false: not every coordinate need be an angle. The discount multiplies the rate inside the scheme, so
    that state and integral are one smooth system of order 4.
    """
    pace = lambda s: horizon * grading * s ** (grading - 1.0)
    weight = lambda s: rho * math.exp(-rho * horizon * s**grading) * pace(s)
    x, total, ds = x0, x0.new_zeros(()), 1.0 / steps
    for k, (after, (r1, r2, r3, r4)) in enumerate(_steps(dynamics, x0, horizon, steps, grading)):
        x = after
        start, middle, end = k * ds, (k + 0.5) * ds, (k + 1.0) * ds
        total = total + ds / 6.0 * (weight(start) * r1 + 2.0 * weight(middle) * (r2 + r3) + weight(end) * r4)
    return total, x.remainder(1.0) if wrap else x


@torch.no_grad()
def path_of(dynamics: Dynamics, x0: Tensor, horizon: float, steps: int, grading: float = 1.0) -> Tensor:
    """The states ``(steps + 1, N, d)`` of the steps that `discounted_integral` takes."""
    return torch.stack([x0, *(x for x, _ in _steps(dynamics, x0, horizon, steps, grading))])


def _steps(
    dynamics: Dynamics, x0: Tensor, horizon: float, steps: int, grading: float
) -> Iterator[tuple[Tensor, tuple[Tensor, ...]]]:
    """The state after each step, and the rates at its four stages."""
    pace = lambda s: horizon * grading * s ** (grading - 1.0)
    x, ds = x0, 1.0 / steps
    for k in range(steps):
        x = Switched.before(dynamics, k, steps, x)
        x, rates = _step(dynamics, x, tuple(ds * pace(s) for s in (k * ds, (k + 0.5) * ds, (k + 1.0) * ds)))
        yield x, rates


@torch.no_grad()
def rate_at(
    dynamics: Dynamics, x0: Tensor, rho: float, times: Tensor, steps: int, wrap: bool = True
) -> tuple[Tensor, Tensor]:
    r"""An estimate of `rho int e^{-rho t} rate(x_t) dt` per trajectory ``(N,)``, and its state ``(N, d)`` at a time of its
    own, by RK4; ``times`` ``(N,)`` are draws of `T ~ Exp(rho)`.

    Not the rate at `T` alone: on a sliding mode that is the rate of one side. For each `s` in `(0, 1]`, `rate(x_{sT})`
    weighted by `s e^{rho T (1 - s)}` has the same mean, by a change of variable; the last quarter of `s` is averaged.
    """
    window = max(1, steps // 4)
    h, ds = (times / steps).unsqueeze(-1), 1.0 / steps
    weight = lambda s: s * (rho * times * (1.0 - s)).exp()
    x, total = x0, x0.new_zeros(())
    for k in range(steps):
        x, (r1, r2, r3, r4) = _step(dynamics, x, (h, h, h))
        if k >= steps - window:
            s = k * ds
            of = [w if r1.dim() == 1 else w.unsqueeze(-1) for w in map(weight, (s, s + 0.5 * ds, s + ds))]
            total = total + (of[0] * r1 + 2.0 * of[1] * (r2 + r3) + of[2] * r4) / 6.0
    return total / window, x.remainder(1.0) if wrap else x


def _step(dynamics: Dynamics, x: Tensor, h: tuple) -> tuple[Tensor, tuple[Tensor, ...]]:
    """The state one step later, and the rates at the four stages; ``h`` is the step in the pace of its start, middle and
    end, which are the same where time is not graded."""
    v1, r1 = dynamics(x)
    v2, r2 = dynamics(x + 0.5 * h[0] * v1)
    v3, r3 = dynamics(x + 0.5 * h[1] * v2)
    v4, r4 = dynamics(x + h[1] * v3)
    return x + (h[0] * v1 + 2.0 * h[1] * (v2 + v3) + h[2] * v4) / 6.0, (r1, r2, r3, r4)


class Refined(NamedTuple):
    """``results`` ``(N,)`` and ``ends`` ``(N, d)`` of trajectories, a bound on the ``error`` of the results' mean, and how
    many ``steps`` ``(N,)`` each took."""

    results: Tensor
    ends: Tensor
    error: float
    steps: Tensor


def in_finer_steps(integrate: Integrate, times: Tensor) -> Integrate:
    """``integrate`` with ``times`` ``(N,)``, at least 1, as many steps as it is asked for, trajectory by trajectory."""

    def each(rows: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        wanted = times[rows]
        kinds = wanted.unique().tolist()
        found = [integrate(rows[wanted == kind], kind * steps) for kind in kinds]
        order = torch.cat([(wanted == kind).nonzero().squeeze(-1) for kind in kinds]).argsort()
        results, ends = (torch.cat(parts)[order] for parts in zip(*found, strict=True))
        return results, ends

    return each


def refined(
    integrate: Integrate,
    weights: Tensor,
    steps: int,
    tolerance: float,
    generator: torch.Generator,
    standard_error: Callable[[Tensor], float] = lambda results: 0.0,
    audit: Integrate | None = None,
    doublings: int = MAX_DOUBLINGS,
    audited: int = AUDITED,
) -> Refined:
    r"""Results of all trajectories, and a bound on the error of their mean by ``weights`` ``(N,)``.

    While the mean change is above ``tolerance``, or a tenth of it and of the ``standard_error`` of the results, trajectories
    that still change by more than ``tolerance`` on halving the step are halved again, ``doublings`` times at most, and while
    they make a part of the mean that matters: these cross a jump or a kink of the controller, or slide along one. The error
    has three parts: the last change of each trajectory; what its slow decay leaves to come (`r/(1-r)` of it, at ratio `r`: a
    jump makes the order 1, not 4); and, because a trajectory may agree with itself by missing a feature twice, what a random
    few of all, ``audited``, change on far finer steps. Where ``integrate`` rounds, ``audit``, which does not, integrates all
    of these few on steps that are no coarser.
    """
    everything = torch.arange(len(weights))
    coarse, _ = integrate(everything, steps // 2)
    result, end = integrate(everything, steps)
    change, factor = (result - coarse).abs(), torch.ones_like(result)
    taken, finest = torch.full(weights.shape, steps), AUDIT_FACTOR * steps
    for _ in range(doublings):
        active = (change > tolerance).nonzero().squeeze(-1)
        good = min(tolerance, GOOD_PART * max(tolerance, standard_error(result)))
        changed = weights * change * factor
        mean = float(changed.mean())
        if mean <= good or float(changed[active].sum()) <= RELEVANT_PART * len(weights) * mean:
            break
        steps *= 2
        finer, end[active] = integrate(active, steps)
        taken[active] = steps
        before = float((weights[active] * change[active]).sum())
        change[active], result[active] = (finer - result[active]).abs(), finer
        ratio = min(float((weights[active] * change[active]).sum()) / max(before, 1e-300), SLOWEST_DECAY)
        factor[active] = max(1.0, ratio / (1.0 - ratio))
    seen = float((weights * change * factor).mean())
    if not audited:
        return Refined(result, end, seen, taken)
    picked = torch.randperm(len(weights), generator=generator)[:audited]
    missed = torch.zeros_like(weights[picked])
    finest = finest if audit is None else max(finest, int(taken[picked].max()))
    rough = (taken[picked] < finest) if audit is None else torch.ones_like(picked, dtype=torch.bool)
    if rough.any():
        rows = picked[rough]
        missed[rough] = weights[rows] * ((audit or integrate)(rows, finest)[0] - result[rows])
    noise = float(missed.std()) / math.sqrt(len(missed)) if len(missed) > 1 else 0.0
    unseen = abs(float(missed.mean())) + 2.0 * noise
    return Refined(result, end, seen + unseen, taken)
