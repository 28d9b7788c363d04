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

from ocp_torch.certificate.lower.shifted import Shift, highest
from ocp_torch.certificate.lower.slack import SlackParts
from ocp_torch.fields.rounded import rounded
from ocp_torch.maths.jets import Field, Jet, jet
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.samples import Samples

# Radii that are tried, from the smallest until two in a row promise less than another (one did beside a gain of .2 %).
RADII = tuple(2.0 ** (0.5 * k) for k in range(-15, -8))
TRIAL_STATES = 2048  # states of all sets together on which a radius is tried
WORST_STATES = 2048  # of largest slack of V, at which its averages are evaluated too, as theirs is large there
TRIAL_ASCENTS = 8  # ascents of such a trial at most
# A trial must promise this part of the bound for all states to be evaluated: for six oscillators that gave .45 % in 60 of
# 230 s. For another radius it must promise as much beyond the bound that the first came to.
LEAST_PROMISE = 3e-4
DIRECTIONS = 8  # directions at most along which neighbours lie
# Evaluations of V at most for the averages at sampled states: with four times as many a bound of dubins was the same to 2e-6,
# in 33 s instead of 19.
EVALUATIONS = 2**18


class Mollified:
    """`x -> (V(x) + sum_k (V(x + h e_k) + V(x - h e_k))) / (2 K + 1)` along the `K` axes, or `DIRECTIONS` random directions
    where there are more. `V` is periodic, and is evaluated in the unit cell."""

    def __init__(self, value: Field, dim: int, radius: float) -> None:
        self.dim = dim
        axes = torch.eye(dim, dtype=torch.float64)
        if dim > DIRECTIONS:
            mixed = torch.randn(dim, DIRECTIONS, generator=fixed_generator(), dtype=torch.float64)
            axes = torch.linalg.qr(mixed).Q.T
        self.value, self.radius = value, radius
        self.offsets = radius * torch.cat([torch.zeros_like(axes[:1]), axes, -axes])  # (2 K + 1, d)

    @property
    def rounded(self) -> "Mollified":
        """This average with `V` in single precision."""
        return Mollified(rounded(self.value), self.dim, self.radius)

    def neighbours(self, x: Tensor) -> Tensor:
        """All states that are averaged over, ``(N (2 K + 1), d)``."""
        return (x.unsqueeze(1) + self.offsets.to(x)).remainder(1.0).flatten(0, 1)

    def __call__(self, x: Tensor) -> Tensor:
        return self.value(self.neighbours(x)).unflatten(0, (len(x), -1)).mean(dim=1)

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """The average of the neighbours' jets, all with the noise ``sigma`` ``(N, d, k)`` at ``x``."""
        sigma = None if sigma is None else sigma.repeat_interleave(len(self.offsets), dim=0)
        return jet(self.value, self.neighbours(x), sigma).map(lambda part: part.unflatten(0, (len(x), -1)).mean(dim=1))

    def fitting(self, sets: list[Samples]) -> list[Samples]:
        """The first states of each of ``sets``, their number halved until `EVALUATIONS` suffice for all."""
        count = len(sets[0])
        while count > 1 and count * len(sets) * len(self.offsets) > EVALUATIONS:
            count //= 2
        return [samples.take(slice(0, count)) for samples in sets]


def mollified_shift(own: Shift) -> Shift:
    """The best shifted bound found of averages of the value of ``own``; ``own`` itself where none is better, or where trials
    on few states promise little.

    Trials promise too much, and about as much too much for one radius as for the next.
    """
    slack = SlackParts.join(own.parts).slack(own.theta)
    worst = Samples.concatenate(own.sets).take(slack.topk(min(WORST_STATES, len(slack))).indices)
    # Peaks in hollows of the slack are peaks of averages too: for six oscillators a search of an average's own missed one of
    # .4 % of the bound.
    steep = [own.problem.samples(own.peaks.x, divergences=False)] if len(own.peaks.x) else []
    beside = [Samples.concatenate([worst, *own.beside, *steep])]
    few = [samples.take(slice(0, max(1, TRIAL_STATES // len(own.sets)))) for samples in own.sets]

    def averaged(radius: float, sets: list[Samples], ascents: int) -> Shift:
        W = Mollified(own.value, own.problem.dim, radius)
        return replace(own, value=W, sets=W.fitting(sets), ascents=ascents, beside=beside, radius=radius, variate=own)

    ascents = min(own.ascents, TRIAL_ASCENTS)
    promised: dict[float, float] = {}
    for radius in RADII:
        promised[radius] = averaged(radius, few, ascents).looked.bound - own.bound
        if max([*promised.values()][-2:]) < max(promised.values()):
            break
    best, too_much = own, 0.0
    for radius in sorted(promised, key=promised.__getitem__, reverse=True):
        if not promised[radius] - too_much > best.bound - own.bound + LEAST_PROMISE * abs(own.bound):
            break
        tried = averaged(radius, own.sets, own.ascents)
        too_much = max(too_much, promised[radius] - (tried.looked.bound - own.bound))
        best = highest([best, tried])
    return best
