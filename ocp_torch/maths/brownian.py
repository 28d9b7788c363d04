r"""The closed loop in time where there is noise: Euler-Maruyama steps, halved on the same Brownian paths, and extrapolated.

Along one path halving a step changes a result by its square root; but the mean changes in proportion to the step (weak order
1), so that twice the finer mean less the coarser one is of order 2 (Talay and Tubaro, 1990). As both are taken on the same
paths, what they differ by shows little of the noise itself.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ocp_torch.maths.runge_kutta import Dynamics
from ocp_torch.maths.seeds import Branch, derive_seed

# What a rate counts at a part of each of the horizons ``(N,)``.
Weight = Callable[[Tensor, float], Tensor]

# Paths that are followed together: their increments are kept while their steps are halved.
TOGETHER = 512
# How often steps are halved at most after the first time.
MOST_HALVINGS = 4
# How far means on steps and on halved steps may differ, as a part of the standard error, before they are halved again.
GOOD_PART = 0.25


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

    @property
    def halved(self) -> "Grid":
        return Grid(self.horizon, 2 * self.steps, self.grading)

    def of(self, rows: slice) -> "Grid":
        """That of the paths ``rows``."""
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
    """`rho e^{-rho t} dt`: what a rate counts up to the horizon."""
    return lambda horizon, part: horizon * rho * torch.exp(-rho * horizon * part)


def at_random_times(rho: float) -> Weight:
    """For horizons `T ~ Exp(rho)`: as for `rate_at`, each `s` in (0, 1] gives the discounted integral in the mean. They are
    averaged over the last quarter, by a weight that is smooth at its ends."""
    smooth = lambda part: 8.0 * math.sin(4.0 * math.pi * part) ** 2 if part > 0.75 else 0.0
    return lambda horizon, part: smooth(part) * part * torch.exp(rho * horizon * (1.0 - part))


@torch.no_grad()
def path_integral(
    dynamics: Dynamics, noise: Callable[[Tensor], Any], x0: Tensor, grid: Grid, moves: Tensor, weight: Weight
) -> tuple[Tensor, Tensor]:
    """`int weight(s) rate(x_t) ds` for `t = horizon s` along each path ``(N,)`` from ``x0`` ``(N, d)``, and its end ``(N,
    d)``.

    ``noise`` gives `sigma` ``(N, d, k)``; ``moves`` ``(steps, N, k)`` are the increments. The rule is the trapezoidal one.
    """
    parts, x, total = grid.parts, x0, torch.zeros_like(grid.horizon)
    widths = torch.nn.functional.pad(parts.diff(), (1, 1))
    for k, part in enumerate(parts.tolist()):
        velocity, rate = dynamics(x)
        total = total + 0.5 * float(widths[k] + widths[k + 1]) * weight(grid.horizon, part) * rate
        if k < grid.steps:
            step = float(widths[k + 1]) * grid.horizon.unsqueeze(-1)
            x = x + step * velocity + torch.einsum("ndk,nk->nd", noise(x), moves[k])
    return total, x


@torch.no_grad()
def expectation(
    dynamics: Dynamics,
    noise: Callable[[Tensor], Any],
    x0: Tensor,
    weights: Tensor,
    grid: Grid,
    weight: Weight,
    tolerance: float,
    seed: int,
    standard_error: Callable[[Tensor], float],
) -> tuple[Tensor, Tensor, float]:
    """`path_integral` of each path, extrapolated ``(N,)``, the ends ``(N, d)``, and a bound on the error of the results'
    mean by ``weights`` ``(N,)``. Steps are halved until halving moves them by less than ``tolerance`` or little beside the
    ``standard_error`` of the results.

    The bias is what the last halving moved the extrapolated mean by, twice its own standard error included.
    """
    motions = noise(x0[:1]).shape[-1]

    def followed(halvings: int) -> tuple[Tensor, Tensor]:
        fine = Grid(grid.horizon, grid.steps * 2**halvings, grid.grading)
        parts = []
        for number, rows in enumerate(_rows(len(x0))):
            moves = increments(grid.of(rows), motions, halvings, seed, number)
            parts.append(path_integral(dynamics, noise, x0[rows], fine.of(rows), moves, weight))
        return torch.cat([r for r, _ in parts]), torch.cat([e for _, e in parts])

    coarse, (fine, end) = followed(0)[0], followed(1)
    result, bias = 2.0 * fine - coarse, math.inf
    for halvings in range(2, MOST_HALVINGS + 1):
        coarse, (fine, end) = fine, followed(halvings)
        before, result = result, 2.0 * fine - coarse
        moved = weights * (result - before)
        bias = abs(float(moved.mean())) + 2.0 * float(moved.std()) / math.sqrt(len(moved))
        if bias <= max(tolerance, GOOD_PART * standard_error(result)):
            break
    return result, end, bias


def _rows(count: int) -> Iterator[slice]:
    return (slice(start, min(start + TOGETHER, count)) for start in range(0, count, TOGETHER))
