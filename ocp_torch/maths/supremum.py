"""Suprema over the torus: sampled, then climbed by local ascent from the worst points."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator

FIRST_STEP = 1e-2  # of an ascent, in turns
STEP_GROWTH = 1.5  # of a step on success
STEP_SHRINKAGE = 0.4  # of a step on failure: by more than it grows, so that steps near a maximum become smaller
# Ascents have arrived when all steps are below this, in turns: a maximum is then the same to 15 digits where the function is
# smooth, to 9 or more for slacks beside kinks.
ARRIVED_STEP = 1e-7
# How far ascents are expected to go where starts are chosen by value and slope: as far as points are apart, and this at most.
# With 8 of 8 seeds they found a peak of a unicycle's slack that ascents from the largest values missed (.09 % of the bound).
REACH = 3e-2
REACH_STEP = 3e-3  # the first step of such ascents
# Part of the starts from which each stage of such ascents goes on, and its steps: as sure as 24 steps from all starts, in two
# thirds of the time.
STAGES = ((1.0, 8), (0.25, 16))
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)  # the golden section
NARROWINGS = 26  # of the interval of `minimiser` by it: 4e-6 of the interval is left


@dataclass(frozen=True)
class Extremum:
    """A supremum that was searched for: an estimate from below of the true one, with the effort of the search."""

    value: float
    x: Tensor  # (d,) where it is attained
    points: int  # states sampled
    ascents: int  # local ascents started from some of them


@torch.no_grad()
def batched(function: Callable[[Tensor], Tensor], x: Tensor, chunk: int = 1024) -> Tensor:
    """``function`` over the rows of ``x`` in chunks, so that memory stays bounded."""
    return torch.cat([function(part) for part in x.split(chunk)])


def supremum(
    function: Callable[[Tensor], Tensor],
    points: Tensor,
    ascents: int = 32,
    steps: int = 60,
    start_step: float = FIRST_STEP,
    differentiable: bool = True,
) -> Extremum:
    """The largest value of ``function`` ``(N, d) -> (N,)`` met at ``points`` and on ascents from the ``ascents`` best.

    Each ascent moves along the normalised gradient (or, when ``differentiable`` is false, along random directions) with
    a step that grows on success and shrinks on failure, so a value never goes down. A NaN anywhere is returned as NaN.
    """
    values = batched(function, points)
    if torch.isnan(values).any():
        worst = int(torch.isnan(values).nonzero()[0])
        return Extremum(float("nan"), points[worst], len(points), 0)
    count = min(ascents, len(points))
    best, index = values.topk(count)
    x, best = climb(function, points[index], best, steps if count else 0, start_step, differentiable)
    top = int(torch.isnan(best).nonzero()[0]) if torch.isnan(best).any() else int(best.argmax())
    return Extremum(float(best[top]), x[top].remainder(1.0), len(points), count)


def climb(
    function: Callable[[Tensor], Tensor],
    x: Tensor,
    best: Tensor,
    steps: int = 60,
    start_step: float = FIRST_STEP,
    differentiable: bool = True,
) -> tuple[Tensor, Tensor]:
    """The ends of local ascents from ``x`` ``(N, d)``, with values ``best`` ``(N,)``, and the values there, after ``steps``
    steps or once all have arrived. All stop at the first NaN that one of them meets, which is then the value of its row."""
    step = torch.full_like(best, start_step)
    generator = fixed_generator()
    slope = value_and_gradient(function, x)[1] if differentiable and steps else torch.zeros_like(x)
    for _ in range(steps):
        direction = slope if differentiable else torch.randn(x.shape, generator=generator).to(x)
        direction = direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-30)
        candidate = x + step.unsqueeze(-1) * direction
        if differentiable:
            reached, ahead = value_and_gradient(function, candidate)
        else:
            reached, ahead = batched(function, candidate), slope
        odd = torch.isnan(reached)
        better = (reached > best) | odd
        x = torch.where(better.unsqueeze(-1), candidate, x)
        best = torch.where(better, reached, best)
        if odd.any():
            break
        slope = torch.where(better.unsqueeze(-1), ahead, slope)
        step = torch.where(better, STEP_GROWTH * step, STEP_SHRINKAGE * step)
        if differentiable and float(step.max()) < ARRIVED_STEP:
            break
    return x, best


def extremes(function: Callable[[Tensor], Tensor], x: Tensor, met: Tensor, count: int, steps: int) -> Tensor:
    """The ends ``(K, d)`` of descents of ``function``, of ``steps`` steps, from the ``count`` states of ``x`` ``(N, d)`` with
    the smallest of its values ``met`` ``(N,)``, and of ascents from as many with the largest."""
    count = min(count, len(met))
    start = torch.cat([(-met).topk(count).indices, met.topk(count).indices])
    sign = torch.ones_like(met[start])
    sign[:count] = -1.0
    ends, _ = climb(lambda at: sign * function(at), x[start], sign * met[start], steps if count else 0)
    return ends.remainder(1.0)


@torch.no_grad()
def peaks_in_reach(
    function: Callable[[Tensor], Tensor], points: Tensor, starts: int, above: float = -math.inf
) -> tuple[Tensor, Tensor]:
    """The ends of ascents of ``function``, ``(K, d)``, and the values there, from at most so many ``starts``: the ``points``
    ``(N, d)`` with the largest `f + reach |grad f|`, to first order the largest value within reach, if it exceeds ``above``.

    Ascents from the largest values miss narrow peaks that stand where ``function`` is low.
    """
    x, (values, slopes) = points, in_parts(lambda at: value_and_gradient(function, at), points)
    promising = values + min(REACH, len(x) ** (-1.0 / x.shape[1])) * slopes.norm(dim=-1)
    starts = min(starts, int((~(promising <= above)).sum()))  # what is not a number is not below
    if starts == 0:
        return x[:0], values[:0]
    for part, steps in STAGES:
        best = promising.topk(math.ceil(part * starts)).indices
        climbed = lambda at, met, steps=steps: climb(function, at, met, steps, REACH_STEP)
        x, values = in_parts(climbed, x[best], values[best])
        promising = values
    return x.remainder(1.0), values


def in_parts(
    function: Callable[..., tuple[Tensor, Tensor]], *columns: Tensor, chunk: int = 1024
) -> tuple[Tensor, Tensor]:
    """``function`` of ``columns`` in chunks of rows, so that memory stays bounded."""
    first, second = zip(*map(function, *(column.split(chunk) for column in columns)), strict=True)
    return torch.cat(first), torch.cat(second)


def value_and_gradient(function: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    """``function`` and its gradient at each row of ``x``; the gradient is 0 where the function is piecewise constant."""
    with torch.enable_grad():
        x = x.detach().requires_grad_(True)
        value = function(x)
        if not value.requires_grad:
            return value, torch.zeros_like(x)
        (gradient,) = torch.autograd.grad(value.sum(), x, materialize_grads=True)
    return value.detach(), gradient


def minimiser(function: Callable[[float], float], low: float, high: float) -> float:
    """The minimiser of a convex ``function`` in ``[low, high]``, to `4e-6` of the interval's length."""
    left, right = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    at_left, at_right = function(left), function(right)
    for _ in range(NARROWINGS):
        if at_right < at_left:
            low, left, at_left = left, right, at_right
            at_right = function(right := low + GOLDEN * (high - low))
        else:
            high, right, at_right = right, left, at_left
            at_left = function(left := high - GOLDEN * (high - low))
    return 0.5 * (low + high)
