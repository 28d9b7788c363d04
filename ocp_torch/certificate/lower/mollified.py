r"""The shifted bound of `V` averaged over neighbours, whose slack has no narrow spikes.

The slack `Q` is convex in `(V, grad V)` at each state, so that for data that do not vary the slack of an average is at most
the average of slacks (Jensen); data that vary add an error of order `h^2` in the radius `h` where `V` is smooth, of order
`h` across kinks. Networks overshoot beside kinks, in spikes a few thousandths of a turn wide with deep negative slack
around: averaged, they are gone, and hardly anything else changes. That a subsolution mollified is one but for such errors
is how the theory of viscosity solutions treats convex Hamiltonians (Barron and Jensen, 1990).
"""

from dataclasses import replace

import torch
from torch import Tensor

from ocp_torch.certificate.estimate import integral
from ocp_torch.certificate.lower.shifted import Shift, highest
from ocp_torch.certificate.lower.slack import SlackParts
from ocp_torch.fields.rounded import rounded
from ocp_torch.maths.jets import Field, Jet, jet
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.samples import Samples

# Radii that are looked at, from the smallest on until two in a row promise less than another (one did beside a gain of .2 %):
# on few of the states and on the worst for V itself, beside which its averages are worst too.
RADII, FEW, WORST, FEW_ASCENTS = tuple(2.0 ** (0.5 * k) for k in range(-15, -8)), 2048, 2048, 8
# All states are asked where these promise that part of the bound, and again, for another radius, where they promise as much
# beyond what the first came to. At half effort that took 30 of 250 s of a unicycle and gave .14 %, 60 of 230 of six
# oscillators and .45 %.
WORTH = 3e-4
# Directions at most along which neighbours lie, and evaluations of V at most.
DIRECTIONS, EVALUATIONS = 8, 2**20


class Mollified:
    """`x -> (V(x) + sum_k V(x + h e_k) + V(x - h e_k)) / (2 k + 1)` along the axes, or ``DIRECTIONS`` random directions
    where there are more. ``V`` is periodic; it is asked for states in the unit cell."""

    def __init__(self, value: Field, dim: int, radius: float) -> None:
        self.dim = dim
        axes = torch.eye(dim, dtype=torch.float64)
        if dim > DIRECTIONS:
            mixed = torch.randn(dim, DIRECTIONS, generator=fixed_generator(), dtype=torch.float64)
            axes = torch.linalg.qr(mixed).Q.T
        self.value, self.radius = value, radius
        self.offsets = radius * torch.cat([torch.zeros_like(axes[:1]), axes, -axes])  # (2 k + 1, d)

    @property
    def rounded(self) -> "Mollified":
        """The same in single precision."""
        return Mollified(rounded(self.value), self.dim, self.radius)

    def neighbours(self, x: Tensor) -> Tensor:
        """All states that are averaged over, ``(N (2 k + 1), d)``."""
        return (x.unsqueeze(1) + self.offsets.to(x)).remainder(1.0).flatten(0, 1)

    def __call__(self, x: Tensor) -> Tensor:
        return self.value(self.neighbours(x)).unflatten(0, (len(x), -1)).mean(dim=1)

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """The average of the neighbours' jets; noise is that at ``x``."""
        sigma = None if sigma is None else sigma.repeat_interleave(len(self.offsets), dim=0)
        return jet(self.value, self.neighbours(x), sigma).map(lambda part: part.unflatten(0, (len(x), -1)).mean(dim=1))

    def fitting(self, sets: list[Samples]) -> list[Samples]:
        """As many of the first states of each of ``sets``, a power of two times fewer, as the budget allows."""
        count = len(sets[0])
        while count > 1 and count * len(sets) * len(self.offsets) > EVALUATIONS:
            count //= 2
        return [samples.take(slice(0, count)) for samples in sets]


def mollified_shift(own: Shift) -> Shift:
    """The best shifted bound that was found of the value of ``own`` averaged; ``own`` itself where none is better, or where
    few states promise little.

    Few states promise too much, and about as much too much for one radius as for the next.
    """
    slack = SlackParts.join(own.parts).slack(own.theta)
    worst = Samples.concatenate(own.sets).take(slack.topk(min(WORST, len(slack))).indices)
    # A peak that stands where the slack is low is an average's too: of six oscillators a search among averages missed one of
    # .4 % of the bound that the search before had found.
    steep = [own.problem.samples(own.peaks.x, divergences=False)] if len(own.peaks.x) else []
    beside = [Samples.concatenate([worst, *own.beside, *steep])]
    few = [samples.take(slice(0, max(1, FEW // len(own.sets)))) for samples in own.sets]

    def averaged(radius: float, sets: list[Samples], ascents: int) -> Shift:
        W = Mollified(own.value, own.problem.dim, radius)
        return replace(own, value=W, sets=W.fitting(sets), ascents=ascents, beside=beside, radius=radius)

    ascents = min(own.ascents, FEW_ASCENTS)
    initial, by_V = sum(own.initial) / len(own.initial), replace(own, sets=few).parts

    def promise(radius: float) -> float:
        """How much higher the bound looks on few states: what `E[V mu0]` is off by there is the average's too."""
        tried = averaged(radius, few, ascents)
        changes = [integral(s, p.initial - v.initial) for s, p, v in zip(few, tried.parts, by_V, strict=True)]
        theta, _, largest = tried.looked
        return theta * (initial + sum(changes) / len(changes)) - largest.value - own.bound

    promised: dict[float, float] = {}
    for radius in RADII:
        promised[radius] = promise(radius)
        if max([*promised.values()][-2:]) < max(promised.values()):
            break
    best, too_much = own, 0.0
    for radius in sorted(promised, key=promised.__getitem__, reverse=True):
        if not promised[radius] - too_much > best.bound - own.bound + WORTH * abs(own.bound):
            break
        tried = averaged(radius, own.sets, own.ascents)
        too_much = max(too_much, promised[radius] - (tried.looked.bound - own.bound))
        best = highest([best, tried])
    return best
