r"""The closed loop in time where there is noise: Euler-Maruyama steps, halved on the same Brownian paths, and extrapolated.

The error along one path is of order 1/2 in the steps, but that of the mean of (weak) order 1, so that twice the mean on
halved steps less the one before is of order 2 (Talay and Tubaro, 1990). On the same paths the difference of both has little
variance, and few paths suffice for it: each halving is made on half of the paths of the one before (multilevel Monte Carlo:
Giles, 2008), and costs no more than it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ocp_torch.compute.threads import in_pieces
from ocp_torch.maths.runge_kutta import Dynamics, Switched
from ocp_torch.maths.seeds import Branch, derive_seed

# Maps horizons ``(N,)``, and a time as a part of them, to the weights of the rates at that time.
Weight = Callable[[Tensor, float], Tensor]

DRAWN_TOGETHER = 512  # paths whose increments are drawn at once
PATHS_PER_PIECE = 256  # that a core follows at a time: small, as each halving has half as many paths to share
MOST_HALVINGS = 5  # of the steps
FEWEST_PATHS = 8  # of each replicate
HALVINGS_ON_FEWEST = 2  # at most: on a fixed number of paths each takes twice as long as the one before
# Steps are halved again where the bias is above this part of the standard error (a quarter took dubins one more halving, a
# sixth of its simulation); the interval contains the bias whatever it is.
GOOD_PART = 0.5
# What is left after the last halving, relative to what that changed, where the drift jumps and means are of weak order 1/2
# only; where it is smooth a third is left.
REMAINDER = 1.0 / (math.sqrt(2.0) - 1.0)


@dataclass(frozen=True)
class Grid:
    """The times of the steps of many paths, each of its own ``horizon`` ``(N,)``: `t_k = horizon (k / steps)^grading`."""

    horizon: Tensor
    steps: int
    grading: float

    @property
    def parts(self) -> Tensor:
        """`t_k / horizon`, ``(steps + 1,)``."""
        return torch.linspace(0.0, 1.0, self.steps + 1, dtype=self.horizon.dtype) ** self.grading

    def of(self, rows: Tensor) -> "Grid":
        """The grid of the paths ``rows``."""
        return Grid(self.horizon[rows], self.steps, self.grading)


def increments(grid: Grid, motions: int, halvings: int, seed: int, rows: int) -> Tensor:
    """Increments of ``motions`` Brownian motions over the steps of ``grid`` once these are halved ``halvings`` times,
    ``(steps 2^halvings, N, motions)``. Fewer halvings give the same paths at fewer times: each midpoint is drawn between its
    two ends (Levy's construction). ``seed`` and the number ``rows`` name the paths."""
    parts, count = grid.parts, len(grid.horizon)
    draw = lambda level: torch.randn(
        len(parts) - 1,
        count,
        motions,
        dtype=parts.dtype,
        generator=torch.Generator().manual_seed(derive_seed(seed, Branch.BROWNIAN, rows, level)),
    )
    moves = parts.diff().sqrt()[:, None, None] * draw(0)
    for level in range(1, halvings + 1):
        finer = Grid(grid.horizon, 2 * (len(parts) - 1), grid.grading).parts
        before, after = finer[1::2] - parts[:-1], parts[1:] - finer[1::2]
        share, spread = before / (before + after), (before * after / (before + after)).sqrt()
        first = share[:, None, None] * moves + spread[:, None, None] * draw(level)
        moves, parts = torch.stack([first, moves - first], dim=1).flatten(0, 1), finer
    return grid.horizon.sqrt().unsqueeze(-1) * moves


def discounted(rho: float) -> Weight:
    """The weight `rho e^{-rho t} dt`, up to the horizon."""
    return lambda horizon, part: horizon * rho * torch.exp(-rho * horizon * part)


def at_random_times(rho: float) -> Weight:
    """The weight for horizons `T ~ Exp(rho)`: as for `rate_at`, each part `s` in (0, 1] of them gives the discounted integral
    in the mean. The last quarter of `s` is averaged, by a weight that is smooth at its ends."""
    smooth = lambda part: 8.0 * math.sin(4.0 * math.pi * part) ** 2 if part > 0.75 else 0.0
    return lambda horizon, part: smooth(part) * part * torch.exp(rho * horizon * (1.0 - part))


@torch.no_grad()
def path_integral(
    dynamics: Dynamics, noise: Callable[[Tensor], Any], x0: Tensor, grid: Grid, moves: Tensor, weight: Weight
) -> tuple[Tensor, Tensor]:
    """`int weight(s) rate(x_t) ds` for `t = horizon s` along each path ``(N,)`` from ``x0`` ``(N, d)``, and its end ``(N,
    d)``.

    ``noise`` gives `sigma` ``(N, d, k)``; ``moves`` ``(steps, N, k)`` are the increments. The rule is the trapezoidal one.
    Where dynamics are `Switched` the rate is the one after the jump, whose error is of the order that halved steps and
    extrapolation remove.
    """
    x, total = x0, torch.zeros_like(grid.horizon)
    widths = torch.nn.functional.pad(grid.parts.diff(), (1, 1))
    for k, (after, rate) in enumerate(_states(dynamics, noise, x0, grid, moves)):
        x = after
        total = total + 0.5 * float(widths[k] + widths[k + 1]) * weight(grid.horizon, float(grid.parts[k])) * rate
    return total, x


@torch.no_grad()
def path_of(dynamics: Dynamics, noise: Callable[[Tensor], Any], x0: Tensor, grid: Grid, seed: int) -> Tensor:
    """The states ``(steps + 1, N, d)`` of paths like those of `path_integral`."""
    moves = increments(grid, noise(x0[:1]).shape[-1], 0, seed, len(x0))
    return torch.stack([x for x, _ in _states(dynamics, noise, x0, grid, moves)])


def _states(
    dynamics: Dynamics, noise: Callable[[Tensor], Any], x0: Tensor, grid: Grid, moves: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    """The states at all times of ``grid``, one after the other, and their rates."""
    x, widths = x0, grid.parts.diff()
    for k in range(grid.steps + 1):
        x = Switched.before(dynamics, k, grid.steps, x) if k < grid.steps else x
        velocity, rate = dynamics(x)
        yield x, rate
        if k < grid.steps:
            step = float(widths[k]) * grid.horizon.unsqueeze(-1)
            x = x + step * velocity + torch.einsum("ndk,nk->nd", noise(x), moves[k])


class Mean(NamedTuple):
    """The mean of a path integral over the paths of each replicate."""

    integrals: Tensor  # (N,) on the first steps
    refinement: Tensor  # (replicates,) what finer steps, extrapolated, add to the weighted mean of each replicate
    end: Tensor  # (N, d) on the first steps
    bias: float  # a bound on the error of the mean over all replicates
    steps: int  # the finest


@dataclass(frozen=True, eq=False)
class Multilevel:
    """The mean by ``weights`` ``(N,)`` of the `path_integral` from ``x0`` ``(N, d)``, ``replicates`` sets one after the
    other, on ever finer steps along ever fewer paths.

    Paths are followed ``together`` on all cores if ``dynamics`` and ``noise`` are pure.
    """

    dynamics: Dynamics
    noise: Callable[[Tensor], Any]
    x0: Tensor
    weights: Tensor
    replicates: int
    grid: Grid
    weight: Weight
    seed: int
    together: bool = False

    @torch.no_grad()
    def mean(self, tolerance: float, audit: Dynamics | None = None) -> Mean:
        """The mean, extrapolated. Steps are halved until halving moves it by less than ``tolerance`` or little beside its
        standard error.

        The bias is what the last halving moved the extrapolated mean by, with twice the standard error of that or
        `REMAINDER` times; and, where the dynamics round, by how much ``audit`` moves the mean over a few paths.
        """
        mass = self.weights.view_as(self._rows)
        thinnings = max(1, self._rows.shape[1] // FEWEST_PATHS).bit_length() - 1
        integrals, end = self._followed(self.dynamics, 0)
        first = mean = (mass * integrals).mean(dim=1)
        coarse, before, bias = integrals, torch.zeros(()), math.inf
        for halvings in range(1, min(MOST_HALVINGS, thinnings + HALVINGS_ON_FEWEST) + 1):
            fine, _ = self._followed(self.dynamics, halvings)
            of = slice(fine.shape[1])
            change = mass[:, of] * (fine - coarse[:, of])
            mean = mean + change.mean(dim=1)
            extrapolated = mean + change.mean(dim=1)
            if halvings > 1:
                moved = (2.0 * change - before[:, of]).flatten()
                size, error = abs(float(moved.mean())), float(moved.std()) / math.sqrt(len(moved))
                bias = max(REMAINDER * size, size + 2.0 * error)
                chance = float(extrapolated.std()) / math.sqrt(self.replicates) if self.replicates > 1 else 0.0
                if bias <= max(tolerance, GOOD_PART * chance):
                    break
            coarse, before = fine, change
        if audit is not None:
            exact, _ = self._followed(audit, 0, thinnings)
            of = slice(exact.shape[1])
            off = (mass[:, of] * (exact - integrals[:, of])).flatten()
            bias += abs(float(off.mean())) + 2.0 * float(off.std()) / math.sqrt(len(off))
        return Mean(integrals.flatten(), extrapolated - first, end, bias, self.grid.steps * 2**halvings)

    @cached_property
    def _rows(self) -> Tensor:
        """The numbers of the paths, ``(replicates, n)``."""
        return torch.arange(len(self.x0)).unflatten(0, (self.replicates, -1))

    def _followed(self, dynamics: Dynamics, halvings: int, thinned: int = 0) -> tuple[Tensor, Tensor]:
        """Integrals ``(replicates, n)`` along the first `n` paths of each replicate, half as many after each of ``halvings``
        or ``thinned`` times, and their ends."""
        rows, grid = self._rows, self.grid
        few = rows[:, : max(FEWEST_PATHS, rows.shape[1] >> max(halvings, thinned))]
        at, fine = few.flatten(), Grid(grid.horizon, grid.steps * 2**halvings, grid.grading)
        drawn = self._drawn(few.shape[1], halvings).flatten(1, 2)
        along = lambda n: path_integral(dynamics, self.noise, self.x0[at[n]], fine.of(at[n]), drawn[:, n], self.weight)
        integrals, end = in_pieces(along, torch.arange(len(at)), self.together, PATHS_PER_PIECE, long=True)
        return integrals.view_as(few), end

    def _drawn(self, count: int, halvings: int) -> Tensor:
        """The increments of the first ``count`` paths of each replicate, ``(steps, replicates, count, motions)``."""
        motions, first, moves = self.noise(self.x0[:1]).shape[-1], 0, []
        for number, chunk in enumerate(self._rows.split(max(1, DRAWN_TOGETHER // self.replicates), dim=1)):
            if first < count:
                drawn = increments(self.grid.of(chunk.flatten()), motions, halvings, self.seed, number)
                moves.append(drawn.unflatten(1, chunk.shape)[:, :, : count - first])
            first += chunk.shape[1]
        return torch.cat(moves, dim=2)
