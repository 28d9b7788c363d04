r"""Upper bounds on `Perf(u)` for one given controller, from any `V` and any `mu >= 0`, without simulation.

Write `Q_u` for the Bellman slack of `V` and `r = mu0 - mu - div(mu g_u) / rho` for the Liouville residual of `mu`, and let
`mu^u` be the true occupation density, so that `Perf(u) = E_{mu^u}[f + R(u)]`.

1. Along the closed loop `d/dt (e^{-rho t} V(x_t)) = -rho e^{-rho t} (Q_u + f + R(u))(x_t)`. Integrated from 0 to infinity:
   `V(x) - V^u(x) = rho int e^{-rho t} Q_u(x_t) dt`, hence `V - eps_lo <= V^u <= V + eps_hi` with
   `eps_lo = sup max(Q_u, 0)` and `eps_hi = sup max(-Q_u, 0)`.
2. `V^u` has Bellman slack 0, so by parts `E[V^u mu0] = E[(f + R(u)) mu + V^u r]` for every `mu`: with `V^u = V + (V^u - V)`,
   `Perf(u) = E[(f + R(u)) mu + V r] + E[(V^u - V) r]`, and by 1 the last term is at most
   `eps_hi E[max(r, 0)] + eps_lo E[max(-r, 0)]`. That sum is the **Lagrangian bound**: wrong by a product of two errors.
3. By parts again `E[(f + R(u)) mu + V r] = E[V mu0 - mu Q_u]`: the same number with far less variance.
4. `0 <= V^u <= C_V` with `C_V = sup V + eps_hi` gives `J = E[(f + R(u)) mu + C_V max(r, 0)]`, with `w = mu u`, for the
   smallest `C_V` that these facts prove for this very controller.
5. All this holds for every multiple `s mu` too, with residual `mu0 - s (mu0 - r)`, and each bound is convex in `s`. Where
   `Q_u` is deep on one side only, as at kinks, a little more mass (`s > 1`) makes the dear side of `r` rare. Each half
   of the sets is evaluated with the `s` that is best on the other half: the search does not flatter the bound.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ocp_torch.certificate.bound import PERFORMANCE, UPPER, Bound, sentence_on
from ocp_torch.certificate.checks.assumptions import Assumptions, found_by_search
from ocp_torch.certificate.checks.hidden import Flux, Hidden, hidden_divergence
from ocp_torch.certificate.checks.tails import widened
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.certificate.lower.shifted import slack_function
from ocp_torch.certificate.upper.multiples import Terms, best_multiples
from ocp_torch.maths.jets import CHUNK, Field
from ocp_torch.maths.supremum import Extremum, batched, supremum
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.needs import Need
from ocp_torch.problems.samples import Samples

if TYPE_CHECKING:
    from ocp_torch.certificate.context import Context


@dataclass(frozen=True)
class ClosedLoopBounds:
    """The bounds of one closed loop and the suprema they rest on, as found."""

    lagrangian: Estimate
    J: Estimate
    C_V: float
    eps_hi: Extremum
    eps_lo: Extremum
    residual: float  # E[|r|]
    below: Estimate  # of Perf(u) from below: 2. with the signs turned
    sandwich: tuple[Estimate, Estimate]  # E[V mu0] - eps_lo <= Perf(u) <= E[V mu0] + eps_hi, by 1. alone
    hidden: Hidden | None = None  # a divergence that the residual does not see: only the sandwich stands then
    contributions: list[list[torch.Tensor]] = field(default_factory=list)  # of `lagrangian` and `J`, parts of each


def closed_loop_bounds(
    loop: ClosedLoop,
    value: Field,
    log_occupation: Field,
    sets: list[Samples],
    ascents: int,
    controller: str | None,
    initial: list[float] | None = None,
    odd: Tensor | None = None,
) -> ClosedLoopBounds:
    """Evaluate both bounds on ``sets`` of samples of ``loop``; the suprema are sampled on them, and at the states ``odd``
    ``(K, d)`` too, and climbed.

    ``initial``, if given, is `E[V mu0]` per set from more states: it carries nearly all of the variance.
    """
    values = [_integrands(loop, value, log_occupation, samples) for samples in sets]
    states = torch.cat([samples.x for samples in sets])
    slack_all = torch.cat([slack for *_, slack, _ in values])
    tops = torch.cat([v for v, *_ in values])
    slack = slack_function(loop, value)
    if odd is not None and len(odd):
        states = torch.cat([states, odd])
        tops, slack_all = torch.cat([tops, batched(value, odd)]), torch.cat([slack_all, batched(slack, odd)])
    top = _climbed(value, tops, states, ascents)
    eps_lo = _climbed(slack, slack_all, states, ascents)
    eps_hi = _climbed(lambda x: -slack(x), -slack_all, states, ascents)
    C_V = top.value + eps_hi.value
    terms = [Terms(samples, *parts[:3]) for samples, parts in zip(sets, values, strict=True)]
    lagrangian, below, J, residual, low, high = [], [], [], [], [], []
    hi, lo = eps_hi.value, eps_lo.value
    excess = best_multiples(terms, lambda t, s: t.lagrangian(s, hi, lo))
    shortfall = best_multiples(terms, lambda t, s: -t.lagrangian(s, -lo, -hi))
    penalised = best_multiples(terms, lambda t, s: t.J(s, C_V))
    for i, own in enumerate(terms):
        started = integral(own.samples, own.v * own.samples.mu0) if initial is None else initial[i]
        lagrangian.append(started + excess[i])
        below.append(started - shortfall[i])
        J.append(started + penalised[i])
        mass = integral(own.samples, own.samples.mu0)
        low.append(started - lo * mass)
        high.append(started + hi * mass)
        residual.append(integral(own.samples, own.r.abs()))
    mean_residual = sum(residual) / len(residual)
    weighted = lambda integrand: [t.samples.weight * integrand(t) for t in terms]
    of_lagrangian, of_below = (weighted(lambda t, s=s: t.lagrangian_integrand(1.0, *s)) for s in ((hi, lo), (-lo, -hi)))
    of_J = weighted(lambda t: t.J_integrand(1.0, C_V))
    found = widened(Estimate.of(lagrangian, controller=controller), of_lagrangian)
    penalised_by = widened(Estimate.of(J), of_J)
    parts_of = lambda estimate, values: [v / (abs(estimate.value) or 1.0) for v in values]
    return ClosedLoopBounds(
        found,
        penalised_by,
        C_V,
        eps_hi,
        eps_lo,
        mean_residual,
        widened(Estimate.of(below), of_below),
        (Estimate.of(low), Estimate.of(high)),
        hidden_divergence([flux for *_, flux in values]),
        [parts_of(found, of_lagrangian), parts_of(penalised_by, of_J)],
    )


@torch.no_grad()
def _integrands(loop: ClosedLoop, value: Field, log_occupation: Field, samples: Samples):
    """`V`, `mu Q_u`, `r` and `Q_u` at the states of ``samples``, and the flux `mu g_u`."""
    generator = Generator.of(loop, samples)
    V = generator.chunked_jet(value)
    slack = generator.hjb_slack(V)
    parts = [Generator.of(loop, part).occupation_flux(log_occupation) for part in samples.split(CHUNK)]
    mu, outflow, moved = (torch.cat(columns) for columns in zip(*parts, strict=True))
    flux = Flux(samples.x, samples.weight, outflow - mu, moved / loop.discount)
    return V.value, mu * slack, samples.mu0 - outflow, slack, flux


def _climbed(function, values: torch.Tensor, states: torch.Tensor, ascents: int) -> Extremum:
    """`sup max(function, 0)`: from the largest of the sampled ``values``, upwards."""
    start = states[values.topk(min(ascents, len(values))).indices]
    found = supremum(function, start, ascents=ascents)
    return Extremum(max(found.value, 0.0), found.x, len(states), found.ascents)


class Lagrangian(Bound):
    """The Lagrangian bound of the controller handed out, from the density that was fitted to its closed loop."""

    name, side, label = "lagrangian", UPPER, "Lagrangian"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return found_by_search("sup |Q_u|"), assumptions.regular

    def evaluate(self, context: Context) -> Estimate | None:
        return context.closed_loop.lagrangian if context.closed_loop else None

    def searches(self, context: Context) -> list[str]:
        return slack_searches(context.closed_loop)


class LagrangianBelow(Lagrangian):
    """The same with the signs turned: it bounds the performance of a given controller from below."""

    side = PERFORMANCE

    def applies(self, context: Context) -> bool:
        return context.external

    def evaluate(self, context: Context) -> Estimate | None:
        return context.closed_loop.below if context.closed_loop else None


def slack_searches(found: ClosedLoopBounds | None) -> list[str]:
    """How the two suprema of the slack behind ``found`` were found."""
    return [] if found is None else [sentence_on("eps_hi", found.eps_hi), sentence_on("eps_lo", found.eps_lo)]
