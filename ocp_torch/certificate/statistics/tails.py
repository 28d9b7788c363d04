r"""Do a few states carry a mean? Then its standard error cannot be trusted, and more states are needed where those are.

Of `N` contributions whose fourth moment is `k` times the square of their second, about `N / k` make the scatter. Where that
is few, states are drawn from a density fitted to the rare ones, with exact weights; what stays rare widens the interval:
where `n` were met there may be `n + 2 sqrt(n) + 3` (Poisson).
The scatter of contributions without variance says nothing, however many are drawn: what lies beyond them is estimated.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from ocp_torch.certificate.statistics.estimate import Estimate, replicated_samples
from ocp_torch.maths.mixture_fit import concentrated
from ocp_torch.maths.mixtures import Mixture
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.sums import summed
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.starts import UNIFORM_STATES, evaluation_distribution

FEW = 30.0  # states behind the scatter, below which a few carry the mean
LEAST_KURTOSIS = 30.0  # kurtosis below which contributions are not examined
HEAVY = 2.0  # contributions that fall off as a lower power have no variance; by one below 1 no mean
LEAST_TAIL = 16  # of `N` contributions the largest `sqrt(N)` tell the power, if they are so many at least
LEAST_POWER = 1.05  # assumed where the largest tell a lower one
ROOM = 2.0  # factor on what is added, off by as much as the power: of 8.5, the mean of `|x|^-.8`, up to .4 was missing
# The largest fourth of them must fall off as slowly: errors of an arm's `V` did not, and .35 % had been added to one mean.
LARGEST_DIVISOR = 4
MATERIAL = 1e-3  # part of the answer below which what a few carry is ignored
ROUNDS = 3  # in which states are drawn anew, at most


def unmet(size: float, draws: int) -> float:
    """What a contribution of that ``size`` adds at most to the mean of ``draws`` that showed none: its probability is `3 / N`
    at most, 95 % sure (the rule of three)."""
    return 3.0 / draws * size


def rarity(contributions: Tensor, size: float) -> float:
    """The error that the mean of ``contributions`` ``(N,)`` may have because a few carry it; 0 where many do, or where what
    they carry is small beside the answer's ``size``."""
    away = (contributions - contributions.mean()).double()
    square = float(away.square().mean())
    if not square > 0.0 or not math.isfinite(square):
        return 0.0
    kurtosis = float((away.square() / square).square().mean())
    behind = max(len(away) / kurtosis, 1.0)
    if kurtosis < LEAST_KURTOSIS or behind >= FEW:
        return 0.0
    carried = float(away.abs().topk(int(FEW)).values.sum()) / len(away)
    return carried * (2.0 * math.sqrt(behind) + 3.0) / behind if carried > MATERIAL * abs(size) else 0.0


def beyond_largest(values: Tensor, weights: Tensor, size: float) -> float:
    """What values larger than any of ``values`` ``(N,)`` add to their mean by ``weights`` ``(N,)``, if the largest fall off
    by a power so low that there is no variance: the values met then say little of them. 0 where they fall off faster, as far
    as the largest tell, or where that is small beside the answer's ``size``.

    The power is the estimate of Hill (1975).
    """
    away = torch.where(weights > 0.0, (values - (weights * values).sum() / weights.sum()).abs(), 0.0).double()
    count = math.isqrt(len(away))
    if count < LEAST_TAIL or not bool(away.isfinite().all()):
        return 0.0
    top = away.topk(count + 1)
    least, largest = float(top.values[-1]), float(top.values[0])
    if not least > 0.0:
        return 0.0
    weight = weights[top.indices].double()
    mass = weight.cumsum(0)[:-1]
    # For a power law these are independent with one exponential distribution; a step gives a single large one.
    spacings = -top.values.log().diff() * mass / weight[1:]
    spread, upper = float(spacings.mean()), spacings[: count // LARGEST_DIVISOR]
    # All of them by a standard error less, the largest by one more: errors of `V` fall off slowly up to the largest slack.
    sure, perhaps = 1.0 - 1.0 / math.sqrt(count), 1.0 + 1.0 / math.sqrt(len(upper))
    if not min(sure * spread, float(spacings.median()) / math.log(2.0), perhaps * float(upper.mean())) * HEAVY > 1.0:
        return 0.0
    power = max(1.0 / spread, LEAST_POWER)
    above = float(mass[-1]) / len(away) * least * power / (power - 1.0)
    more = ROOM * above * (largest / least) ** (1.0 - power)
    return more if more > MATERIAL * abs(size) else 0.0


def widened(estimate: Estimate, contributions: list[Tensor]) -> Estimate:
    """``estimate`` with its interval widened by the `rarity` of the ``contributions`` it is the mean of."""
    rare = rarity(torch.cat(contributions), estimate.value)
    return replace(estimate, bias=(estimate.bias or 0.0) + rare) if rare > 0.0 else estimate


class HasContributions(Protocol):
    """A result with the weighted integrands per set of each of its means, as parts of the answer."""

    @property
    def contributions(self) -> list[list[Tensor]]: ...


R = TypeVar("R", bound=HasContributions)


def sharpened(evaluate: Callable[[list[Samples]], R], problem: Problem, sets: list[Samples], seed: int) -> R:
    """``evaluate`` on ``sets`` of samples of ``problem``, or, while few samples carry a mean, on sets of that size drawn from
    a density fitted to those few."""
    found = evaluate(sets)
    for k in range(ROUNDS):
        rare = [c for c in found.contributions if rarity(torch.cat(c), 1.0) > 0.0]
        if not rare:
            break
        away = summed((torch.cat(c) - torch.cat(c).mean()).abs() for c in rare)
        x, weight = (torch.cat([getattr(s, name) for s in sets]) for name in ("x", "weight"))
        fitted = concentrated(x, away, 1.0 / weight)
        narrow = [d for d in (fitted, evaluation_distribution(problem)) if not d.is_uniform]
        if not narrow:
            break
        distribution = Mixture.join([d.scaled((1.0 - UNIFORM_STATES) / len(narrow)) for d in narrow])
        divergences, fresh = sets[0].div_a is not None, derive_seed(seed, Branch.TAILS, k)
        sets = replicated_samples(problem, len(sets[0]), len(sets), fresh, divergences, distribution)
        found = evaluate(sets)
    return found
