"""The terms of the bounds of a closed loop, and the best multiple of `mu`: bounds hold for each, and are convex in it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ocp_torch.certificate.checks.hidden import Flux
from ocp_torch.certificate.statistics.estimate import integral
from ocp_torch.maths.jets import CHUNK, Field
from ocp_torch.maths.supremum import minimiser
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples

# The interval in which the multiple is sought: from no mass at all to twice what was fitted.
MULTIPLES = (0.0, 2.0)


@dataclass(frozen=True)
class Terms:
    """`V` (``v``), `mu Q_u` (``spent``) and `r` on one set of samples, each ``(N,)``. The methods give integrands ``(N,)`` of
    bounds with ``scale`` times `mu`, without `E[V mu0]`; their numbers are those of `lagrangian`."""

    samples: Samples
    v: Tensor
    spent: Tensor
    r: Tensor

    def residual(self, scale: float) -> Tensor:
        """The residual of ``scale`` times `mu`."""
        return self.samples.mu0 - scale * (self.samples.mu0 - self.r)

    def lagrangian(self, scale: float, hi: float, lo: float) -> Tensor:
        """Bound 2: `hi max(r, 0) + lo max(-r, 0) - mu Q_u`."""
        r = self.residual(scale)
        return hi * r.clamp_min(0.0) + lo * (-r).clamp_min(0.0) - scale * self.spent

    def J(self, scale: float, C_V: float) -> Tensor:
        """Bound 4: `C_V max(r, 0) - V r - mu Q_u`."""
        r = self.residual(scale)
        return C_V * r.clamp_min(0.0) - self.v * r - scale * self.spent

    @staticmethod
    def join(terms: "Sequence[Terms]") -> "Terms":
        """The terms of all sets as those of one."""
        columns = (torch.cat([getattr(t, name) for t in terms]) for name in ("v", "spent", "r"))
        return Terms(Samples.concatenate([t.samples for t in terms]), *columns)


@torch.no_grad()
def terms_on(loop: Generator, value: Field, log_occupation: Field) -> tuple[Terms, Tensor, Tensor, Flux]:
    """The terms of any ``value`` and ``log_occupation`` on the samples of ``loop``; `Q_u` and `mu` ``(N,)`` there; and the
    flux `mu g_u - div(D mu)` over `rho`."""
    samples, V = loop.data, loop.chunked_jet(value)
    slack = loop.hjb_slack(V)
    parts = [replace(loop, data=part).occupation_flux(log_occupation) for part in samples.split(CHUNK)]
    mu, outflow, moved = (torch.cat(columns) for columns in zip(*parts, strict=True))
    flux = Flux(samples.x, samples.weight, outflow - mu, moved / loop.rho)
    return Terms(samples, V.value, mu * slack, samples.mu0 - outflow), slack, mu, flux


Integrand = Callable[[Terms, float], Tensor]


def best_multiple(terms: Terms, integrand: Integrand) -> float:
    """The multiple of `mu` for which the mean of ``integrand`` is smallest."""
    return minimiser(lambda scale: integral(terms.samples, integrand(terms, scale)), *MULTIPLES)


def best_multiples(terms: Sequence[Terms], integrand: Integrand) -> list[float]:
    """The mean of ``integrand`` on each of ``terms``, with the multiple of `mu` that is best on the other half of them."""
    scales = [best_multiple(Terms.join(terms[k::2]), integrand) for k in (0, 1)]
    return [integral(t.samples, integrand(t, scales[1 - i % 2])) for i, t in enumerate(terms)]
