r"""A lower bound that needs no `M`: `E[W mu0] - sup Q_W <= OPT` for any smooth `W`, here for `W = theta V`.

A constant `c` added to `W` adds `c` to its slack, so `W - sup Q_W` is a subsolution of the HJB equation. For `V` scaled by
`theta` the slack `Q_{theta V} = theta (V - L^0 V / rho) - f + R*(-theta B^T grad V / rho)` is convex in `theta` at
every state, so the bound is concave in `theta`: its maximum is found by a search on a line. (Scaling `V - c` instead of `V`
changes nothing.) Where the slack of `V` is large, as at kinks, a `theta` below 1 lowers it for a little of `E[V mu0]`.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from ocp_torch.certificate.lower.slack import MAX_THETA, Scaled, SlackParts, slack_function
from ocp_torch.certificate.statistics.estimate import Estimate, integrals
from ocp_torch.fields.rounded import rounded
from ocp_torch.maths.jets import Field
from ocp_torch.maths.peaks import NEGLIGIBLE, STEEP_ASCENTS, Peaks, climbed_from, steep_peaks
from ocp_torch.maths.supremum import Extremum, minimiser
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

AVERAGED_DIVISOR = 4  # of ascents in steep places for averages: for six oscillators all of them took 70 s or more


class Scaling(NamedTuple):
    """``theta``, `E[W mu0]` and `sup Q_{theta W}`."""

    theta: float
    initial: float
    largest: Extremum

    @property
    def bound(self) -> float:
        """`E[theta W mu0] - sup Q_{theta W}`."""
        return self.theta * self.initial - self.largest.value


@dataclass(frozen=True, eq=False)
class Shift:
    """The shifted bound of the best multiple of a ``value`` `W` on ``sets`` of samples of ``problem``.

    The supremum of the slack is climbed from the ``ascents`` worst of all states, those ``beside`` included; where it is
    ``sought``, also by `STEEP_ASCENTS` times as many ascents in each search in steep places. ``name`` is `W` in words;
    it is averaged over neighbours at ``radius``, unless that is 0. ``variate`` is the bound of a function near `W`, on
    larger sets that begin with these states, from which `E[W mu0]` then starts. Properties are computed when first asked for.
    """

    problem: Problem
    value: Field
    sets: list[Samples]
    ascents: int
    beside: list[Samples]
    name: str = "V"
    radius: float = 0.0
    variate: "Shift | None" = None
    sought: bool = True

    @cached_property
    def parts(self) -> list[SlackParts]:
        """What the slack of every multiple is made of, per set."""
        return self._parts_on(self.sets)

    def _parts_on(self, sets: list[Samples]) -> list[SlackParts]:
        return [SlackParts.of(L, L.chunked_jet(self.value)) for L in (Generator.of(self.problem, s) for s in sets)]

    @cached_property
    def initial(self) -> list[float]:
        """`E[W mu0]`, per set; by the mean of its difference from a ``variate``, where there is one."""
        states, values = [samples.x for samples in self.sets], [parts.initial for parts in self.parts]
        weights = [samples.weight for samples in self.sets]
        if self.variate is None:
            return integrals(states, values, weights)
        known = [parts.initial[: len(own)] for parts, own in zip(self.variate.parts, values, strict=True)]
        changes = integrals(states, [own - v for own, v in zip(values, known, strict=True)], weights)
        return [mean + change for mean, change in zip(self.variate.initial, changes, strict=True)]

    @cached_property
    def _sampled(self) -> SlackParts:
        return SlackParts.join([*self.parts, *self._parts_on(self.beside)])

    @cached_property
    def _plain(self) -> Extremum:
        return climbed(self.problem, self.value, self._sampled, 1.0, self.ascents)

    @cached_property
    def looked(self) -> Scaling:
        """The best multiple by the sampled states and ascents from the largest slacks alone."""
        return self._scaled(self._sampled, self._plain)

    @cached_property
    def peaks(self) -> Peaks:
        """Peaks of the slack in steep places, from where more than the known supremum may be in reach."""
        if not self.sought:
            return Peaks(self._sampled.x[:0], 0)
        slack, rough = (slack_function(self.problem, value) for value in (self.value, rounded(self.value)))
        starts = STEEP_ASCENTS * self.ascents
        if self.radius:  # peaks are as wide as the radius, and each value takes many evaluations
            starts = max(1, starts // AVERAGED_DIVISOR)
        return steep_peaks(slack, rough, self.problem.dim, starts, self._plain.value, self.looked.initial)

    @cached_property
    def found(self) -> Scaling:
        """The best multiple by `looked` and by the peaks in steep places."""
        best, peaks = self.looked, self.peaks
        if len(peaks.x):
            there = Samples.of(self.problem, peaks.x, divergences=False)
            everywhere = SlackParts.join([self._sampled, *self._parts_on([there])])
            if not float(everywhere.slack(best.theta).max()) <= best.largest.value:  # NaN is no bound either
                plain = climbed(self.problem, self.value, everywhere, 1.0, self.ascents)
                best = self._scaled(everywhere, plain)
        ascents = min(self.ascents, len(self._sampled.x)) + peaks.ascents
        return best._replace(largest=replace(best.largest, points=len(self._sampled.x), ascents=ascents))

    def _scaled(self, everywhere: SlackParts, plain: Extremum) -> Scaling:
        """The multiple 1, whose supremum is ``plain``, or the one that maximises the bound over the states ``everywhere``.

        The supremum at the maximiser is climbed to anew, and 1 stays where the states or that supremum show no gain. Where
        `f < 0` is met, against the problem's promise, 0 is no subsolution to scale towards, and `theta` is 1.
        """
        mean = sum(self.initial) / len(self.initial)
        unscaled = Scaling(1.0, mean, plain)
        if bool((everywhere.f < 0.0).any()):
            return unscaled
        theta = scaled_by(everywhere, mean)
        gain = (theta - 1.0) * mean + float(everywhere.slack(1.0).max() - everywhere.slack(theta).max())
        if gain <= NEGLIGIBLE * abs(mean):  # not worth another climb, as where `V` solves the equation
            return unscaled
        scaled = Scaling(theta, mean, climbed(self.problem, self.value, everywhere, theta, self.ascents))
        return max(unscaled, scaled, key=lambda scaling: scaling.bound)

    @property
    def theta(self) -> float:
        return self.found.theta

    @property
    def largest(self) -> Extremum:
        """`sup Q_{theta W}`."""
        return self.found.largest

    @property
    def bound(self) -> float:
        """`E[theta W mu0] - sup Q_{theta W}`."""
        return self.found.bound

    @property
    def estimate(self) -> Estimate:
        """The bound; a negative supremum shifts `W` up."""
        return Estimate.of([self.theta * e - self.largest.value for e in self.initial])

    @property
    def sentence(self) -> str:
        """Which function's slack the supremum is of, in words."""
        averaged = f", averaged {self.radius:.2g} around," if self.radius else ""
        return f"sup Q of {self.theta:.4g} {self.name}{averaged}"


def highest(shifts: list[Shift]) -> Shift:
    """The shift with the highest bound. Steep places are searched only where that decides: peaks there lower a bound."""
    looked = lambda shift: -math.inf if math.isnan(shift.looked.bound) else shift.looked.bound
    best, *others = sorted(shifts, key=looked, reverse=True)
    for other in others:
        if other.looked.bound <= best.bound:
            break
        best = other if other.bound > best.bound else best
    return best


def climbed(problem: Problem, value: Field, parts: SlackParts, theta: float, ascents: int) -> Extremum:
    """`sup Q_{theta V}`, climbed to from the states of ``parts`` where it is largest."""
    scaled = value if theta == 1.0 else Scaled(value, theta)
    return climbed_from(slack_function(problem, scaled), parts.slack(theta), parts.x, ascents)


def scaled_by(parts: SlackParts, initial: float) -> float:
    """The `theta` in `[0, MAX_THETA]` that maximises the bound on sampled states, which is concave in `theta`."""
    return minimiser(lambda theta: float(parts.slack(theta).max()) - theta * initial, 0.0, MAX_THETA)
