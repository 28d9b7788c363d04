"""What the residual of a density adds to the Lagrangian bound, as a fit judges it: at a few states, and where `Q_u` peaks."""

from dataclasses import replace

import torch

from ocp_torch.certificate.estimate import integral
from ocp_torch.certificate.lower.slack import TOP, SlackParts, slack_peaks
from ocp_torch.certificate.upper.multiples import best_multiple, terms_on
from ocp_torch.maths.jets import Field
from ocp_torch.maths.supremum import minimiser
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples

# Ascents of either sign, and their steps. Of 64 coordinates the largest slack at 4,096 states was .1 where ascents found 7.
PEAKS, CLIMBED = 32, 40


class Excess:
    """The excess of any `mu` beside a ``value`` `V` on ``samples`` of ``loop``: what the Lagrangian bound is above
    `E[V mu0 - mu Q_u]`, relative to `|E[V mu0]|`, for the best multiples of `mu` and of `V`.

    The bound holds for each `theta V`, and is convex in `theta` as `Q_u` is linear in `V`. Where `V` is a little too large
    at its maxima `sup Q_u` is all there: on a torus in two dimensions it was a tenth for `theta = .996`, and the bound .021 %
    above the optimum for .037 %.

    Suprema of `Q_u` are those at the samples, with ``ascents`` also where these end.
    """

    @torch.no_grad()
    def __init__(self, loop: ClosedLoop, value: Field, samples: Samples, ascents: bool = False) -> None:
        self.loop, self.value, self.samples = loop, value, samples
        own = Generator.of(loop, samples)
        parts = SlackParts.of(own, own.chunked_jet(value))
        self.initial, self.slack = integral(samples, parts.initial), parts.slack
        if ascents:
            peaks, _ = slack_peaks(loop, value, samples.x, PEAKS, CLIMBED)
            there = Generator.of(loop, Samples.of(loop, peaks, divergences=False))
            met = SlackParts.join([parts, SlackParts.of(there, there.jet(value))])
            self.met = met.slack
        else:
            self.met = self.slack

    @property
    def unit(self) -> float:
        """`|E[V mu0]|`."""
        return max(abs(self.initial), 1e-30)

    def suprema(self, theta: float = 1.0) -> tuple[float, float]:
        """`eps_hi` and `eps_lo` of `theta V`, as met."""
        slack = self.met(theta)
        return float((-slack).max().clamp_min(0.0)), float(slack.max().clamp_min(0.0))

    @torch.no_grad()
    def of(self, log_occupation: Field) -> tuple[float, float]:
        """The excess of this density, and the `theta` that gives it."""
        terms, _, mu, _ = terms_on(Generator.of(self.loop, self.samples), self.value, log_occupation)
        plain = self.initial - integral(self.samples, terms.spent)

        def bound(theta: float, scale: float | None = None) -> tuple[float, float]:
            """The bound, and the multiple of `mu`, the best one where none is given."""
            hi, lo = self.suprema(theta)
            scaled = replace(terms, v=theta * terms.v, spent=mu * self.slack(theta))
            integrand = lambda t, s: t.lagrangian(s, hi, lo)
            scale = best_multiple(scaled, integrand) if scale is None else scale
            return theta * self.initial + integral(self.samples, integrand(scaled, scale)), scale

        least, scale = bound(1.0)
        theta = minimiser(lambda theta: bound(theta, scale)[0], 0.0, TOP)
        tried, _ = bound(theta)
        theta = theta if tried < least else 1.0
        return (min(tried, least) - plain) / self.unit, theta
