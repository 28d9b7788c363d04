r"""The shifted bound of `V` averaged over neighbours, whose slack has no narrow spikes.

The slack `Q` is convex in `(V, grad V)` at each state, so that for data that do not vary the slack of an average is at most
the average of slacks (Jensen); data that vary over the radius `h` add an error of order `h^2` where `grad V` does not, of
order `h` elsewhere. Networks overshoot beside kinks, in spikes a few thousandths of a turn wide with deep negative slack
around: averaged, they are gone, and hardly anything else changes. A subsolution mollified is how the theory of viscosity
solutions proves comparison for convex Hamiltonians (Barron and Jensen, 1990).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch import calculus
from ocp_torch.calculus import Field
from ocp_torch.certificate.shifted import Shift, slack_parts
from ocp_torch.problems.problem import Problem
from ocp_torch.samples import Samples

# Radii that are tried, in turns, until so many in a row are worse than the best; on so many states in all.
RADII, PATIENCE, TRIALS = tuple(2.0**-k for k in range(8, 3, -1)), 2, 4096
# Directions at most along which neighbours lie, and evaluations of V at most.
DIRECTIONS, EVALUATIONS = 8, 2**20


class Mollified:
    """`x -> (V(x) + sum_k V(x + h e_k) + V(x - h e_k)) / (2 k + 1)` along the axes, or ``DIRECTIONS`` random directions
    where there are more. ``V`` is periodic; it is asked for states in the unit cell."""

    def __init__(self, value: Field, dim: int, radius: float) -> None:
        axes = torch.eye(dim, dtype=torch.float64)
        if dim > DIRECTIONS:
            generator = torch.Generator().manual_seed(0)
            mixed = torch.randn(dim, DIRECTIONS, generator=generator, dtype=torch.float64)
            axes = torch.linalg.qr(mixed).Q.T
        self.value, self.radius = value, radius
        self.offsets = radius * torch.cat([torch.zeros_like(axes[:1]), axes, -axes])  # (2 k + 1, d)

    def neighbours(self, x: Tensor) -> Tensor:
        """All states that are averaged over, ``(N (2 k + 1), d)``."""
        return (x.unsqueeze(1) + self.offsets.to(x)).remainder(1.0).flatten(0, 1)

    def __call__(self, x: Tensor) -> Tensor:
        return self.value(self.neighbours(x)).unflatten(0, (len(x), -1)).mean(dim=1)

    def value_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Value ``(N,)`` and gradient ``(N, d)``."""
        found = calculus.value_and_gradient(self.value, self.neighbours(x))
        value, gradient = (part.unflatten(0, (len(x), -1)).mean(dim=1) for part in found)
        return value, gradient

    def fitting(self, sets: list[Samples]) -> list[Samples]:
        """As many of the first states of each of ``sets``, a power of two times fewer, as the budget allows."""
        count = len(sets[0])
        while count > 1 and count * len(sets) * len(self.offsets) > EVALUATIONS:
            count //= 2
        return [samples.take(slice(0, count)) for samples in sets]


def mollified_shift(problem: Problem, value: Field, sets: list[Samples], ascents: int) -> Shift | None:
    """The shifted bound of ``value`` averaged at the radius that looks best on the first states of ``sets``; `None` where
    ``value`` itself does."""
    first = [samples.take(slice(0, max(1, TRIALS // len(sets)))) for samples in sets]
    best, worse = Shift.of(problem, value, first, slack_parts(problem, value, first), ascents), 0
    for radius in RADII:
        tried = _shift(problem, value, radius, first, ascents)
        best, worse = (tried, 0) if tried.bound > best.bound else (best, worse + 1)
        if worse == PATIENCE:
            break
    return _shift(problem, value, best.radius, sets, ascents) if best.radius else None


def _shift(problem: Problem, value: Field, radius: float, sets: list[Samples], ascents: int) -> Shift:
    averaged = Mollified(value, problem.dim, radius)
    sets = averaged.fitting(sets)
    return Shift.of(problem, averaged, sets, slack_parts(problem, averaged, sets), ascents, radius)
