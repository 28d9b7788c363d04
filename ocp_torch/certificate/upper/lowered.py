r"""The slack of functions `W` of `V` along one closed loop, and the `W` with the lowest Lagrangian bound.

The bound holds for each `W = V - s h(V)`, and is convex in `s` as `Q_u` is linear in `W`. Here `h(V)` is `V` itself, so that
`W` is a multiple of `V`, or the part of `V` above a height. Where kinks cross, `V` is a little too large at its maxima, and
`sup Q_u` is attained there alone: on a torus in two dimensions it was .004 for `W = V` and .0001 for `W = .987 V`, and the
bound .067 and .031 % above the optimum. Lowering `V` only above half of its largest value brought the bound to .015 %.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.lower.slack import MAX_THETA
from ocp_torch.certificate.statistics.estimate import integral
from ocp_torch.certificate.upper.multiples import Terms, best_multiple
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.fields.rounded import rounded
from ocp_torch.maths.jets import Field, Jet
from ocp_torch.maths.peaks import STEEP_ASCENTS, Peaks, steep_peaks
from ocp_torch.maths.supremum import Extremum, extremes, minimiser
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator, pull_back
from ocp_torch.problems.samples import Samples

LEAST_GAIN = 1e-7  # another function must lower the bound by more than this part of `|E[V mu0]|`: less is rounding
# Heights above which `V` is lowered, as parts of its range: of eight heights on four tori .3 was best three times, .8 once.
HEIGHTS = (0.3, 0.6, 0.9)
BEND = 0.25  # the slope of `h` grows from 0 to 1 within this part of the range above the height
# How often at most the best function is chosen and its slack climbed: another one may lower a spike that ascents find.
MOST_CHOICES = 4
# Climbing ends where no supremum grows by more than this part of itself,
GROWTH = 0.01
# or where the bound rises by no more than this part of `|E[V mu0]|`: ascents in eight coordinates take 2.2 s instead of 3.7.
BOUND_RISE = 1e-6


@dataclass(frozen=True)
class Above:
    """`h(v)`: 0 below ``height``, of slope 1 above ``height + width``, a parabola between; `h(v) = v` without a height."""

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
    """`W = V - by h(V)` for the `h` that ``above`` is."""

    above: Above = Above()
    by: float = 0.0

    def __call__(self, v: Tensor) -> Tensor:
        """`W` at values ``v`` of `V`."""
        return v - self.by * self.above(v)[0]

    def jet(self, V: Jet, sigma: Tensor | None = None) -> Jet:
        """The jet of `W`, with its curvature along ``sigma`` ``(N, d, k)``, from the jet of `V`."""
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


class SampledSlack(NamedTuple):
    """States ``(N, d)``, and there `V`, its slack, `L^u V / rho` and its `spread` over `rho`, each ``(N,)``."""

    x: Tensor
    v: Tensor
    slack: Tensor
    transport: Tensor
    spread: Tensor

    @classmethod
    def at(cls, loop: Generator, value: Field) -> "SampledSlack":
        samples, V = loop.data, loop.chunked_jet(value)
        moved, zero = loop.transport(V), torch.zeros_like(V.value)
        varied = zero if samples.noise is None else spread(samples.noise, V) / loop.rho
        return cls(samples.x, V.value, loop.hjb_slack(V), zero if moved is None else moved, varied)

    def part(self, above: Above) -> Tensor:
        """The slack of `V` less that of `W`, per unit of ``by``, ``(N,)``."""
        h, slope, bend = above(self.v)
        return h - slope * self.transport - bend * self.spread

    def of(self, how: Lowering) -> Tensor:
        """`Q_u` of `W`, ``(N,)``."""
        return self.slack - how.by * self.part(how.above)


class LoweredSlack:
    """`Q_u` of any `W` on ``samples`` of ``loop``. Its suprema are the largest values there, at states ``odd`` ``(K, d)``,
    at the peaks that were ``sought`` before, on other samples, and where ascents have ended (`climb`, `seek`)."""

    @torch.no_grad()
    def __init__(
        self, loop: ClosedLoop, value: Field, samples: Samples, odd: Tensor | None = None, sought: Peaks | None = None
    ) -> None:
        self.loop, self.value, self.samples = loop, value, samples
        self.sampled = self.met = SampledSlack.at(Generator.of(loop, samples), value)
        self.sought = sought or Peaks(samples.x[:0], 0)
        self.initial = integral(samples, self.sampled.v * samples.mu0)
        low, high = (float(v) for v in self.sampled.v.aminmax())
        heights = [low + part * (high - low) for part in HEIGHTS] if high > low else []
        self.choices = [Above(), *(Above(height, BEND * (high - height)) for height in heights)]
        for x in (self.sought.x, odd):
            if x is not None and len(x):  # a given controller may refuse an empty batch
                self._meet(x)

    def _meet(self, x: Tensor) -> None:
        """Include the states ``x`` ``(K, d)`` in the suprema from now on."""
        there = Generator.of(self.loop, Samples.of(self.loop, x, divergences=False))
        self.met = SampledSlack(*map(torch.cat, zip(self.met, SampledSlack.at(there, self.value), strict=True)))

    @property
    def unit(self) -> float:
        """`|E[V mu0]|`."""
        return max(abs(self.initial), 1e-30)

    def suprema(self, how: Lowering = UNCHANGED) -> tuple[float, float]:
        """`eps_hi` and `eps_lo` of `W` over all states met so far."""
        return _sides(self.met.of(how))

    def _slack_of(self, how: Lowering, value: Field) -> Field:
        """`x -> Q_u(x)` of `W`, made of ``value``: `V`, or `V` in single precision."""
        policy = self.loop.policy
        own = policy if isinstance(policy, ValuePolicy) and policy.value is self.value else None

        def slack(x: Tensor) -> Tensor:
            problem = self.loop if own is None else self.loop.problem
            generator = Generator.of(problem, Samples.live(problem, x))
            V, data = generator.jet(value), generator.data
            W = how.jet(V, data.noise)
            # One jet of `V` gives both the control and the slack of the controller from `V`.
            return generator.hjb_slack(W) if own is None else generator.bellman_slack(W, own.control(data.B, V))

        return slack

    @torch.no_grad()
    def climb(self, how: Lowering, ascents: int, steps: int = 60) -> None:
        """Include the ends of ``ascents`` from where the slack of `W` is largest, and of descents; each takes ``steps``."""
        self._meet(extremes(self._slack_of(how, self.value), self.met.x, self.met.of(how), ascents, steps))

    @torch.no_grad()
    def seek(self, how: Lowering, ascents: int) -> bool:
        """Include peaks of the slack of `W`, and of its negative, in steep places, sought by `STEEP_ASCENTS` times as many
        ascents in each search; return whether any is higher than all that was met before."""
        slack, rough = (self._slack_of(how, value) for value in (self.value, rounded(self.value)))
        below, roughly_below = (lambda x: -slack(x)), (lambda x: -rough(x))
        met, dim, starts = self.met.of(how), self.samples.x.shape[1], STEEP_ASCENTS * ascents
        for exact, near, known in ((slack, rough, met.max()), (below, roughly_below, -met.min())):
            peaks = steep_peaks(exact, near, dim, starts, float(known), self.unit)
            if len(peaks.x):
                self._meet(peaks.x)
            self.sought = Peaks(torch.cat([self.sought.x, peaks.x]), max(self.sought.ascents, peaks.ascents))
        return any(now > seen for now, seen in zip(self.suprema(how), _sides(met), strict=True))

    def extrema(self, how: Lowering, ascents: int) -> tuple[Extremum, Extremum]:
        """`suprema`, where they were met, and the number of ascents: ``ascents`` and those in steep places."""

        def largest(side: Tensor) -> Extremum:
            top, seen = int(side.argmax()), len(self.sampled.x)
            climbed = min(ascents, seen) + self.sought.ascents
            return Extremum(max(float(side[top]), 0.0), self.met.x[top], seen, climbed)

        slack = self.met.of(how)
        return largest(-slack), largest(slack)

    def climbed_lowest(self, terms: Terms, ascents: int) -> Lowering:
        """The `W` with the lowest bound for the ``terms`` of a density, among those whose slack was climbed."""
        tried: list[Lowering] = []
        bound = lambda how: self._along(terms, how.above)(how.by)[0]
        for _ in range(MOST_CHOICES):
            lowest, how = self.lowest(terms)
            tried.append(how)
            before = self.suprema(how)
            self.climb(how, ascents)
            higher = any(now > (1.0 + GROWTH) * seen for now, seen in zip(self.suprema(how), before, strict=True))
            if not higher or bound(how) <= lowest + BOUND_RISE * self.unit:
                break
        return min(tried, key=bound)

    @torch.no_grad()
    def lowest(self, terms: Terms) -> tuple[float, Lowering]:
        """The lowest Lagrangian bound for the ``terms`` of a density, by the suprema met, among multiples of the density and
        all `W`; and its `W`: `V` itself where no other is lower by `LEAST_GAIN`.

        By parts `E[W mu0 - mu Q_u]` for `W` is that for `V` less `s E[h(V) r]`, which scatters little: no `W` is chosen by
        chance.
        """
        lowest, scale = self._along(terms, Above())(0.0)
        how = UNCHANGED
        for above in self.choices:
            bound = self._along(terms, above)
            by = minimiser(lambda by: bound(by, scale)[0], 1.0 - MAX_THETA, 1.0)  # noqa: B023
            found, _ = bound(by)
            if found < lowest - LEAST_GAIN * self.unit:
                lowest, how = found, Lowering(above, by)
        return lowest, how

    def _along(self, terms: Terms, above: Above) -> Callable[..., tuple[float, float]]:
        """A function of `s` and a multiple of the density, by default the best: the bound with `W`, and that multiple."""
        part, h = self.met.part(above), above(terms.v)[0]

        def bound(by: float, scale: float | None = None) -> tuple[float, float]:
            hi, lo = _sides(self.met.slack - by * part)
            integrand = lambda t, s: t.lagrangian(s, hi, lo) - by * h * t.residual(s)
            scale = best_multiple(terms, integrand) if scale is None else scale
            return self.initial + integral(self.samples, integrand(terms, scale)), scale

        return bound

    def excess(self, terms: Terms) -> float:
        """The `lowest` bound less `E[V mu0 - mu Q_u]`, relative to `|E[V mu0]|`: what the residual adds to it."""
        return (self.lowest(terms)[0] - self.initial + integral(self.samples, terms.spent)) / self.unit


def _sides(slack: Tensor) -> tuple[float, float]:
    """`eps_hi` and `eps_lo` of a ``slack`` ``(N,)``."""
    low, high = slack.aminmax()
    return max(-float(low), 0.0), max(float(high), 0.0)
