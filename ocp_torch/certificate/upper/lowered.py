r"""The slack of functions made of `V` along one closed loop, and the one for which the Lagrangian bound is lowest.

The bound holds for each `W = V - s h(V)`, and is convex in `s` as `Q_u` is linear in `V`. Here `h(V)` is `V` itself, so that
`W` is a multiple of it, or what of `V` lies above some height. Where `V` is a little too large at its maxima, where kinks
cross, `sup Q_u` is all there: on a torus in two dimensions `sup Q_u` was .004 for `W = V` and .0001 for `W = .987 V`, and the
bound .067 and .031 % above the optimum. A multiple has its price wherever `V` is not 0: where `W` had .98 of only what of `V`
is above half of its largest, the bound was .015 % above.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.estimate import integral
from ocp_torch.certificate.lower.slack import STARTS, TOP, Peaks, steep_peaks
from ocp_torch.certificate.upper.multiples import Terms, best_multiple
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.fields.rounded import rounded
from ocp_torch.maths.jets import Field, Jet
from ocp_torch.maths.supremum import Extremum, extremes, minimiser
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator, pull_back
from ocp_torch.problems.samples import Samples

# What another function must give, relative to `|E[V mu0]|`: less is rounding.
LEAST = 1e-7
# Heights above which `V` is lowered, in parts of its range, and within which part of what is left the slope changes. Of eight
# heights on four tori .3 was best three times and .8 once; .5 to .9 differ little where the spike is at the top alone.
HEIGHTS, BEND = (0.3, 0.6, 0.9), 0.25
# Ascents may find a spike that another function of `V` makes lower: the best one is sought, and its slack climbed, so many
# times, or until no ascent ends higher than that part above what was met, or the bound rises by less than that part of
# `|E[V mu0]|`: where `V` solves its equation higher spikes are always found, and hardly count. In eight coordinates the
# ascents then take 2.2 s for 3.7.
TIMES, HIGHER, RISE = 4, 0.01, 1e-6


@dataclass(frozen=True)
class Above:
    """`h(v)`: 0 below ``height``, of slope 1 from ``width`` above it on, a parabola between; `v` where there is no height."""

    height: float | None = None
    width: float = 0.0

    def __call__(self, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`h`, `h'` and `h''` at ``v``."""
        if self.height is None:
            return v, torch.ones_like(v), torch.zeros_like(v)
        over = (v - self.height).clamp_min(0.0)
        bent = (over > 0.0) & (over < self.width)
        h = torch.where(bent, over.square() / (2.0 * self.width), (over - 0.5 * self.width).clamp_min(0.0))
        return h, (over / self.width).clamp_max(1.0), bent.to(v) / self.width


class Lowering(NamedTuple):
    """``by`` times what of `V` is ``above``."""

    above: Above = Above()
    by: float = 0.0

    def __call__(self, v: Tensor) -> Tensor:
        """`W` at values ``v`` of `V`."""
        return v - self.by * self.above(v)[0]

    def jet(self, V: Jet, sigma: Tensor | None = None) -> Jet:
        """That of `W`, with its curvature along ``sigma`` ``(N, d, k)``, for that of `V`."""
        h, slope, bend = self.above(V.value)
        steep = 1.0 - self.by * slope
        curvature = None if sigma is None else steep * V.curvature - self.by * bend * spread(sigma, V)
        return Jet(V.value - self.by * h, steep.unsqueeze(-1) * V.gradient, curvature)

    def __str__(self) -> str:
        part = f"{1.0 - self.by:.4g}"
        return f"{part} V" if self.above.height is None else f"V, {part} of it above {self.above.height:.4g}"


UNCHANGED = Lowering()


def spread(sigma: Tensor, V: Jet) -> Tensor:
    """`D : grad V grad V^T`, ``(N,)``: half the rate of the quadratic variation of `V` along paths."""
    return 0.5 * pull_back(sigma, V.gradient).square().sum(-1)


class Met(NamedTuple):
    """States, and `V`, its slack, `L^u V / rho` and its `spread` over `rho` there."""

    x: Tensor
    v: Tensor
    slack: Tensor
    transport: Tensor
    spread: Tensor

    @classmethod
    def at(cls, loop: Generator, value: Field) -> "Met":
        samples, V = loop.data, loop.chunked_jet(value)
        moved, zero = loop.transport(V), torch.zeros_like(V.value)
        varied = zero if samples.noise is None else spread(samples.noise, V) / loop.rho
        return cls(samples.x, V.value, loop.hjb_slack(V), zero if moved is None else moved, varied)

    def part(self, above: Above) -> Tensor:
        """What the slack of `W` is less than that of `V`, for each unit of ``by``."""
        h, slope, bend = above(self.v)
        return h - slope * self.transport - bend * self.spread

    def of(self, how: Lowering) -> Tensor:
        """`Q_u` of `W`."""
        return self.slack - how.by * self.part(how.above)


class LoweredSlack:
    """`Q_u` of any `W` on ``samples`` of ``loop``; its suprema are sought there, at the states ``odd`` ``(K, d)`` too, where
    ascents have ended (`climb`), and at the peaks that were ``sought`` before, on other samples."""

    @torch.no_grad()
    def __init__(
        self, loop: ClosedLoop, value: Field, samples: Samples, odd: Tensor | None = None, sought: Peaks | None = None
    ) -> None:
        self.loop, self.value, self.samples = loop, value, samples
        self.sampled = self.met = Met.at(Generator.of(loop, samples), value)
        self.sought = sought or Peaks(samples.x[:0], 0)
        self.initial = integral(samples, self.sampled.v * samples.mu0)
        low, high = (float(v) for v in self.sampled.v.aminmax())
        heights = [low + part * (high - low) for part in HEIGHTS] if high > low else []
        self.choices = [Above(), *(Above(height, BEND * (high - height)) for height in heights)]
        for x in (self.sought.x, odd):
            if x is not None and len(x):  # a controller of somebody else's may refuse to be asked for no state
                self._meet(x)

    def _meet(self, x: Tensor) -> None:
        """From now on the states ``x`` count too."""
        there = Generator.of(self.loop, Samples.of(self.loop, x, divergences=False))
        self.met = Met(*map(torch.cat, zip(self.met, Met.at(there, self.value), strict=True)))

    @property
    def unit(self) -> float:
        """`|E[V mu0]|`."""
        return max(abs(self.initial), 1e-30)

    def suprema(self, how: Lowering = UNCHANGED) -> tuple[float, float]:
        """`eps_hi` and `eps_lo` of `W`, as met."""
        return _sides(self.met.of(how))

    def _slack_of(self, how: Lowering, value: Field) -> Field:
        """`x -> Q_u(x)` of `W`, made of ``value``, which is `V` or nearly so."""
        policy = self.loop.policy
        own = policy if isinstance(policy, ValuePolicy) and policy.value is self.value else None

        def slack(x: Tensor) -> Tensor:
            problem = self.loop if own is None else self.loop.problem
            generator = Generator.of(problem, Samples.live(problem, x))
            V, data = generator.jet(value), generator.data
            W = how.jet(V, data.noise)
            # Of the controller of `V` one jet gives the control and the slack.
            return generator.hjb_slack(W) if own is None else generator.bellman_slack(W, own.control(data.B, V))

        return slack

    @torch.no_grad()
    def climb(self, how: Lowering, ascents: int, steps: int = 60) -> None:
        """Meet the ends of so many ``steps`` of ``ascents`` from where the slack of `W` is smallest and largest."""
        self._meet(extremes(self._slack_of(how, self.value), self.met.x, self.met.of(how), ascents, steps))

    @torch.no_grad()
    def seek(self, how: Lowering, ascents: int) -> bool:
        """Meet the peaks of the slack of `W` in steep places, and of what it is below 0, by `STARTS` times as many ascents or
        more, and say whether any is higher than what was met before."""
        slack, rough = (self._slack_of(how, value) for value in (self.value, rounded(self.value)))
        below, roughly_below = (lambda x: -slack(x)), (lambda x: -rough(x))
        met, dim, starts = self.met.of(how), self.samples.x.shape[1], STARTS * ascents
        for exact, near, known in ((slack, rough, met.max()), (below, roughly_below, -met.min())):
            peaks = steep_peaks(exact, near, dim, starts, float(known), self.unit)
            if len(peaks.x):
                self._meet(peaks.x)
            self.sought = Peaks(torch.cat([self.sought.x, peaks.x]), max(self.sought.ascents, peaks.ascents))
        return any(now > seen for now, seen in zip(self.suprema(how), _sides(met), strict=True))

    def extrema(self, how: Lowering, ascents: int) -> tuple[Extremum, Extremum]:
        """`suprema`, and where they were met: by so many ``ascents`` among others."""

        def largest(side: Tensor) -> Extremum:
            top, seen = int(side.argmax()), len(self.sampled.x)
            climbed = min(ascents, seen) + self.sought.ascents
            return Extremum(max(float(side[top]), 0.0), self.met.x[top], seen, climbed)

        slack = self.met.of(how)
        return largest(-slack), largest(slack)

    def climbed_lowest(self, terms: Terms, ascents: int) -> Lowering:
        """The best `W`, for the ``terms`` of any density, of those whose slack was climbed, by all that was met."""
        tried: list[Lowering] = []
        bound = lambda how: self._along(terms, how.above)(how.by)[0]
        for _ in range(TIMES):
            lowest, how = self.lowest(terms)
            tried.append(how)
            before = self.suprema(how)
            self.climb(how, ascents)
            higher = any(now > (1.0 + HIGHER) * seen for now, seen in zip(self.suprema(how), before, strict=True))
            if not higher or bound(how) <= lowest + RISE * self.unit:
                break
        return min(tried, key=bound)

    @torch.no_grad()
    def lowest(self, terms: Terms) -> tuple[float, Lowering]:
        """The lowest Lagrangian bound for the ``terms`` of any density, with the suprema met, among all multiples of it and
        all `W`; and which that is, `V` itself where no other does better.

        By parts `E[W mu0 - mu Q_u]` of `W` is that of `V` less `s E[h(V) r]`, which scatters little: none is chosen by
        chance.
        """
        lowest, scale = self._along(terms, Above())(0.0)
        how = UNCHANGED
        for above in self.choices:
            bound = self._along(terms, above)
            by = minimiser(lambda by: bound(by, scale)[0], 1.0 - TOP, 1.0)  # noqa: B023
            found, _ = bound(by)
            if found < lowest - LEAST * self.unit:
                lowest, how = found, Lowering(above, by)
        return lowest, how

    def _along(self, terms: Terms, above: Above) -> Callable[..., tuple[float, float]]:
        """By `s`, the bound of `W` and the multiple of the density: the best one, where none is given."""
        part, h = self.met.part(above), above(terms.v)[0]

        def bound(by: float, scale: float | None = None) -> tuple[float, float]:
            hi, lo = _sides(self.met.slack - by * part)
            integrand = lambda t, s: t.lagrangian(s, hi, lo) - by * h * t.residual(s)
            scale = best_multiple(terms, integrand) if scale is None else scale
            return self.initial + integral(self.samples, integrand(terms, scale)), scale

        return bound

    def excess(self, terms: Terms) -> float:
        """What the residual adds to that bound, relative to `|E[V mu0]|`: what it is above `E[V mu0 - mu Q_u]`."""
        return (self.lowest(terms)[0] - self.initial + integral(self.samples, terms.spent)) / self.unit


def _sides(slack: Tensor) -> tuple[float, float]:
    """`eps_hi` and `eps_lo` of a ``slack``."""
    low, high = slack.aminmax()
    return max(-float(low), 0.0), max(float(high), 0.0)
