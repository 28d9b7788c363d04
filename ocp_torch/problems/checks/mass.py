"""The mass of a density that may be very narrow: sampled evenly first, then where its mass was met."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.errors import ProblemError
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator
from ocp_torch.problems.checks.functions import Functions
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced
from ocp_torch.problems.simulator.simulator import Simulator

Density = Callable[[Tensor], Tensor]
# Places of a density's peaks ``(K, d)``, their half-widths along each coordinate ``(K, d)``, and their heights ``(K,)``.
Peaks = tuple[Tensor, Tensor, Tensor]

REPLICATES = 16  # independent estimates of the mass
QUANTILE = 5.2391  # Student's t of their mean, two-sided level 0.9999, 15 degrees of freedom
CLOSE = 0.01  # half-width of the interval below which no closer look is needed
TOLERANCE = 1e-4  # what quadrature and rounding may leave beyond the interval
# A half-width below this part of the value shows that no mass was missed: a wider one may owe its mass to few states.
SETTLED = 0.5
LOOKS = 4  # closer looks, at most
PEAKS = 8  # peaks kept
EVEN = 0.3  # part of the states of a closer look that stays evenly spread
CLIMB = 120  # random steps of a climb to a peak
FIRST_STEP = 0.05  # length of the first, in turns
STEP_RANGE = (1e-9, 0.3)  # of the lengths of all steps
GROWTH = 2.0  # of the length after a step up
DECAY = 0.8  # of the length after any other step
NARROWEST = 30  # half-widths 2^-1 to 2^-NARROWEST of a peak are told apart
BROAD = 0.5  # half-width from which on a peak counts as flat along a coordinate


@dataclass(frozen=True)
class Mass:
    """An estimate ``value``, the half-width ``half`` of its interval, and how many ``states`` it took."""

    value: float
    half: float
    states: int

    @property
    def wrong(self) -> bool:
        """Whether the mass is certainly not 1. A missed peak can only add mass, so that a value below 1 must be settled."""
        settled = self.half <= SETTLED * self.value
        return self.value - self.half > 1.0 + TOLERANCE or (settled and self.value + self.half < 1.0 - TOLERANCE)

    @property
    def right(self) -> bool:
        """Whether the mass is 1 as closely as the check needs."""
        return self.half <= CLOSE and abs(self.value - 1.0) <= self.half + TOLERANCE

    @property
    def above(self) -> bool:
        """Whether the mass is certainly above 1, and known closely enough to end the looks."""
        return self.half <= CLOSE and self.value - self.half > 1.0 + TOLERANCE

    @property
    def sentence(self) -> str:
        if self.value == 0.0:
            return f"is 0 at all of {self.states:,} states"
        return f"integrates to {self.value:.4g} (+- {self.half:.1g}, from {self.states:,} states)"


def require_mass(functions: Functions) -> None:
    """Raise where `mu0` certainly does not integrate to 1."""
    problem = functions.problem
    known = not replaced(problem, "initial_density", Problem, System)
    if known or (isinstance(problem, Simulator) and not problem._oracle.gives_mu0):
        return
    found = sampled_mass(lambda x: functions.ask("initial_density", x), problem.dim, functions.count // 4)
    if found.wrong:
        raise ProblemError(
            f"initial_density of {functions.name} {found.sentence}, but must integrate to 1 over the torus."
        )


def sampled_mass(density: Density, dim: int, count: int) -> Mass:
    """The integral of ``density`` ``(N, d) -> (N,)`` over the torus, from ``REPLICATES * count`` evenly spread states.

    Where these do not settle it, up to `LOOKS` times as many are drawn from a mixture fitted to the peaks that were found.
    """
    sets = [scrambled_sobol(count, dim, derive_seed(0, Branch.MASS, r), torch.float64) for r in range(REPLICATES)]
    x = torch.cat(sets)
    share = density(x)  # of the mass, times the number of states
    found = _estimate(share, len(x))
    none = torch.empty(0, dim, dtype=torch.float64)
    peaks: Peaks = none, none, none[:, 0]
    for look in range(LOOKS):
        if found.right or found.above:
            break
        climbed, asked = _climbed(density, x, share)
        peaks = _distinct(*(torch.cat(parts) for parts in zip(peaks, climbed, strict=True)))
        generator = torch.Generator().manual_seed(derive_seed(0, Branch.MASS, REPLICATES, look))
        x = _drawn(peaks, REPLICATES * count, generator)
        share = density(x) / _density(x, peaks)
        found = _estimate(share, found.states + asked + len(x))
    return found


def _estimate(share: Tensor, states: int) -> Mass:
    means = share.reshape(REPLICATES, -1).mean(dim=1)
    se = float(means.std()) / math.sqrt(REPLICATES)
    return Mass(float(means.mean()), QUANTILE * se, states)


def _climbed(density: Density, x: Tensor, share: Tensor) -> tuple[Peaks, int]:
    """Peaks reached by random climbs from the states with the largest ``share``, and how many evaluations that took."""
    at = x[share.topk(PEAKS).indices].clone()
    height, step = density(at), torch.full((PEAKS, 1), FIRST_STEP, dtype=torch.float64)
    generator = fixed_generator()
    for _ in range(CLIMB):
        there = (at + step * torch.randn(at.shape, dtype=torch.float64, generator=generator)).remainder(1.0)
        reached = density(there)
        better = (reached > height).unsqueeze(-1)
        at, height = torch.where(better, there, at), torch.maximum(height, reached)
        step = (step * torch.where(better, GROWTH, DECAY)).clamp(*STEP_RANGE)
    distances = 2.0 ** -torch.arange(1, NARROWEST + 1, dtype=torch.float64)
    widths = torch.full_like(at, 1.0)
    for i in range(at.shape[1]):
        moved = at.repeat(2 * NARROWEST, 1, 1)  # (2 NARROWEST, PEAKS, d)
        moved[:, :, i] += torch.cat([distances, -distances]).unsqueeze(-1)
        half = density(moved.flatten(0, 1)).reshape(2, NARROWEST, PEAKS) < 0.5 * height
        nearest = torch.where(half, distances.view(1, -1, 1), 1.0).amin(dim=1)  # (2, PEAKS), on either side
        widths[:, i] = nearest.amax(dim=0)
    return (at, widths, height), PEAKS * (1 + CLIMB + 2 * NARROWEST * at.shape[1])


def _distinct(at: Tensor, widths: Tensor, heights: Tensor) -> Peaks:
    """The highest peaks, one of each group that lies within a width of one another, at most `PEAKS`."""
    kept: list[int] = []
    for k in heights.argsort(descending=True).tolist():
        away = ((at[kept] - at[k] + 0.5).remainder(1.0) - 0.5).abs() > widths[kept]
        if bool(away.any(dim=1).all()):
            kept.append(k)
    kept = kept[:PEAKS]
    return at[kept], widths[kept], heights[kept]


def _drawn(peaks: Peaks, count: int, generator: torch.Generator) -> Tensor:
    """``count`` states ``(count, d)`` of the mixture `_density`: uniform ones, and wrapped Cauchy draws around each peak."""
    centres, widths, _ = peaks
    draw = lambda *shape: torch.rand(*shape, dtype=torch.float64, generator=generator)
    which = torch.randint(len(centres), (count,), generator=generator)
    even = draw(count, centres.shape[1])
    offset = widths[which] * torch.tan(math.pi * (draw(count, centres.shape[1]) - 0.5))
    near = torch.where(widths[which] >= BROAD, even, (centres[which] + offset).remainder(1.0))
    return torch.where(draw(count, 1) < EVEN, even, near)


def _density(x: Tensor, peaks: Peaks) -> Tensor:
    """The density of the mixture that `_drawn` draws from, ``(N,)``.

    A wrapped Cauchy density is sinh g / (cosh g - cos 2 pi t) with g = 2 pi width."""
    total = torch.zeros_like(x[:, 0])
    for centre, width, _ in zip(*peaks, strict=True):
        g = 2.0 * math.pi * width
        # cosh g - cos 2 pi t as a sum of squares, which loses no digits where both are small.
        gap = 2.0 * ((0.5 * g).sinh().square() + (math.pi * (x - centre)).sin().square())
        total += torch.where(width >= BROAD, 1.0, g.sinh() / gap).prod(dim=-1)
    return EVEN + (1.0 - EVEN) * total / len(peaks[0])
