"""The slack of multiples of `V` along one closed loop, and the multiple for which the Lagrangian bound is lowest."""

import torch
from torch import Tensor

from ocp_torch.certificate.estimate import integral
from ocp_torch.certificate.lower.slack import TOP, Scaled, SlackParts, slack_function, slack_peaks
from ocp_torch.certificate.upper.multiples import Terms, best_multiple
from ocp_torch.maths.jets import Field
from ocp_torch.maths.supremum import Extremum, minimiser
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples

# What another multiple of `V` must give, relative to `|E[V mu0]|`: less is rounding.
LEAST = 1e-7


class ScaledSlack:
    """`Q_u` of `theta V` on ``samples`` of ``loop`` for a ``value`` `V` and any `theta`; its suprema are sought there, at the
    states ``odd`` ``(K, d)`` too, and where ascents have ended (`climb`).

    The Lagrangian bound holds for each `theta V`, and is convex in `theta` as `Q_u` is linear in `V`. Where `V` is a little
    too large at its maxima `sup Q_u` is all there: on a torus in two dimensions it was a tenth for `theta = .996`, and the
    bound .021 % above the optimum for .037 %.
    """

    @torch.no_grad()
    def __init__(self, loop: ClosedLoop, value: Field, samples: Samples, odd: Tensor | None = None) -> None:
        self.loop, self.value, self.samples = loop, value, samples
        generator = Generator.of(loop, samples)
        self.parts = self.met = SlackParts.of(generator, generator.chunked_jet(value))
        self.initial = integral(samples, self.parts.initial)
        if odd is not None and len(odd):
            self._meet(odd)

    def _meet(self, x: Tensor) -> None:
        """From now on the states ``x`` count too."""
        there = Generator.of(self.loop, Samples.of(self.loop, x, divergences=False))
        self.met = SlackParts.join([self.met, SlackParts.of(there, there.chunked_jet(self.value))])

    @property
    def unit(self) -> float:
        """`|E[V mu0]|`."""
        return max(abs(self.initial), 1e-30)

    def suprema(self, theta: float = 1.0) -> tuple[float, float]:
        """`eps_hi` and `eps_lo` of `theta V`, as met."""
        slack = self.met.slack(theta)
        return float((-slack).max().clamp_min(0.0)), float(slack.max().clamp_min(0.0))

    @torch.no_grad()
    def climb(self, theta: float, ascents: int, steps: int = 60) -> tuple[Extremum, Extremum]:
        """`eps_hi` and `eps_lo` of `theta V` after so many ``steps`` of ``ascents`` from the states with the smallest and the
        largest slack met, whose ends are met too."""
        function, seen = slack_function(self.loop, Scaled(self.value, theta)), len(self.met.x)
        self._meet(slack_peaks(function, self.met.x, self.met.slack(theta), ascents, steps))

        def largest(side: Tensor) -> Extremum:
            top = int(side.argmax())
            return Extremum(max(float(side[top]), 0.0), self.met.x[top], seen, min(ascents, seen))

        slack = self.met.slack(theta)
        return largest(-slack), largest(slack)

    @torch.no_grad()
    def lowest(self, terms: Terms) -> tuple[float, float]:
        """The lowest Lagrangian bound for the ``terms`` of any density, with the suprema met, among all multiples of it and
        of `V`; and the `theta` that gives it, 1 where no other does better.

        By parts `E[theta V mu0 - mu Q_u]` of `theta V` is that of `V` and `(theta - 1) E[V r]`, which scatters little: no
        `theta` is chosen by chance.
        """

        def bound(theta: float, scale: float | None = None) -> tuple[float, float]:
            """The bound, and the multiple of the density: the best one, where none is given."""
            hi, lo = self.suprema(theta)
            integrand = lambda t, s: t.lagrangian(s, hi, lo) + (theta - 1.0) * t.v * t.residual(s)
            scale = best_multiple(terms, integrand) if scale is None else scale
            return self.initial + integral(self.samples, integrand(terms, scale)), scale

        plain, scale = bound(1.0)
        theta = minimiser(lambda theta: bound(theta, scale)[0], 0.0, TOP)
        tried, _ = bound(theta)
        return (tried, theta) if tried < plain - LEAST * self.unit else (plain, 1.0)

    def excess(self, terms: Terms) -> float:
        """What the residual adds to that bound, relative to `|E[V mu0]|`: what it is above `E[V mu0 - mu Q_u]`."""
        return (self.lowest(terms)[0] - self.initial + integral(self.samples, terms.spent)) / self.unit
