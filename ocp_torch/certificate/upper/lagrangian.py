r"""Upper bounds on `Perf(u)` for one given controller, from any `V` and any `mu >= 0`, without simulation.

Write `Q_u` for the Bellman slack of `V` and `r = mu0 - mu - div(mu g_u) / rho` for the Liouville residual of `mu`, and let
`mu^u` be the true occupation density, so that `Perf(u) = E_{mu^u}[f + R(u)]`. With noise `r` has `div div(D mu) / rho` beside
that, and what is said along trajectories holds in the mean over paths (Ito's formula).

1. Along the closed loop `d/dt (e^{-rho t} V(x_t)) = -rho e^{-rho t} (Q_u + f + R(u))(x_t)`. Integrated from 0 to infinity:
   `V(x) - V^u(x) = rho int e^{-rho t} Q_u(x_t) dt`, hence `V - eps_lo <= V^u <= V + eps_hi` with
   `eps_lo = sup max(Q_u, 0)` and `eps_hi = sup max(-Q_u, 0)`.
2. `V^u` has Bellman slack 0, so by parts `E[V^u mu0] = E[(f + R(u)) mu + V^u r]` for every `mu`: with `V^u = V + (V^u - V)`,
   `Perf(u) = E[(f + R(u)) mu + V r] + E[(V^u - V) r]`, and by 1 the last term is at most
   `eps_hi E[max(r, 0)] + eps_lo E[max(-r, 0)]`. That sum is the **Lagrangian bound**, off by a product of two errors.
3. By parts again `E[(f + R(u)) mu + V r] = E[V mu0 - mu Q_u]`: the same number with far less variance.
4. `0 <= V^u <= C_V` with `C_V = sup V + eps_hi` gives `J = E[(f + R(u)) mu + C_V max(r, 0)]`, with `w = mu u`, for the
   smallest `C_V` that these facts prove for this very controller.
5. All this holds for every function `W` of `V` too, and the best of a few is taken (`LoweredSlack`).
6. It holds for every multiple `s mu`, whose residual is `mu0 - s (mu0 - r)`, and each bound is convex in `s`. Where `Q_u`
   is large on one side only, as at kinks, a little more mass (`s > 1`) makes the costly side of `r` rare. Each half of the
   sets is evaluated with the `s` that is best on the other half, so that the search does not flatter the bound.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ocp_torch.certificate.checks.hidden import Hidden, hidden_divergence
from ocp_torch.certificate.statistics.estimate import Estimate, integral
from ocp_torch.certificate.statistics.tails import widened
from ocp_torch.certificate.upper.lowered import LoweredSlack, Lowering
from ocp_torch.certificate.upper.multiples import Integrand, Terms, best_multiples, terms_on
from ocp_torch.maths.jets import Field
from ocp_torch.maths.peaks import Peaks, climbed_from
from ocp_torch.maths.supremum import Extremum, batched
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples


@dataclass(frozen=True)
class ClosedLoopBounds:
    """The bounds of one closed loop and the suprema they rest on, as found."""

    lagrangian: Estimate
    J: Estimate
    C_V: float
    eps_hi: Extremum
    eps_lo: Extremum
    below: Estimate  # a lower bound on Perf(u): 2. with its signs reversed
    sandwich: tuple[Estimate, Estimate]  # E[V mu0] - eps_lo <= Perf(u) <= E[V mu0] + eps_hi, by 1. alone
    hidden: Hidden | None  # a divergence that the residual does not see: only the sandwich stands then
    contributions: list[list[Tensor]]  # weighted integrands of `lagrangian` and `J` over their values
    sup_occupation: float  # the largest `mu` met
    occupation: Field  # `mu` itself
    how: Lowering  # the function `W` of `V` that the bounds use
    sought: Peaks  # peaks of its slack in steep places


def closed_loop_bounds(
    loop: ClosedLoop,
    value: Field,
    log_occupation: Field,
    sets: list[Samples],
    ascents: int,
    controller: str | None,
    initial: list[float] | None = None,
    odd: Tensor | None = None,
    sought: Peaks | None = None,
) -> ClosedLoopBounds:
    """All bounds of ``loop`` on ``sets`` of its samples. Suprema are climbed from the worst of these and of states ``odd``
    ``(K, d)``, and sought in steep places, unless they were ``sought`` there for other sets. ``initial``, if given, is
    `E[V mu0]` per set from more states: it carries nearly all of the variance."""
    found = [terms_on(Generator.of(loop, samples), value, log_occupation) for samples in sets]
    plain, _, densities, fluxes = zip(*found, strict=True)
    whole = Terms.join(plain)
    own = LoweredSlack(loop, value, whole.samples, odd, sought)
    how = own.climbed_lowest(whole, ascents)
    if sought is None and own.seek(how, ascents):
        how = own.climbed_lowest(whole, ascents)
    eps_hi, eps_lo = own.extrema(how, ascents)
    slacks = own.sampled.of(how).split([len(samples) for samples in sets])
    columns = zip(plain, densities, slacks, strict=True)
    terms = [replace(t, v=how(t.v), spent=density * slack) for t, density, slack in columns]
    states, values, mu = whole.samples.x, whole.v, torch.cat(densities)
    occupation = lambda x: log_occupation(x).exp()
    if odd is not None and len(odd):
        states = torch.cat([states, odd])
        values = torch.cat([values, batched(value, odd)])
        mu = torch.cat([mu, batched(occupation, odd)])
    highest = max(climbed_from(value, values, states, ascents).value, 0.0)
    top = float(how(values.new_tensor(highest)))  # sup W, since W grows with V
    hi, lo, C_V = eps_hi.value, eps_lo.value, top + eps_hi.value
    started = [integral(t.samples, t.v * t.samples.mu0) for t in terms]
    if initial:  # the mean of V from more states, that of W - V from these
        own_means = [integral(t.samples, t.v * t.samples.mu0) for t in plain]
        started = [e + mean - of_v for e, mean, of_v in zip(initial, started, own_means, strict=True)]

    def bound(integrand: Integrand, sign: float = 1.0) -> tuple[Estimate, list[Tensor]]:
        """`E[W mu0]` plus ``sign`` times the mean of ``integrand``; and the weighted integrand for `mu` itself, per set."""
        excess = best_multiples(terms, integrand)
        found = Estimate.of([e + sign * x for e, x in zip(started, excess, strict=True)])
        weighted = [t.samples.weight * integrand(t, 1.0) for t in terms]
        return widened(found, weighted), weighted

    lagrangian, of_lagrangian = bound(lambda t, s: t.lagrangian(s, hi, lo))
    below, _ = bound(lambda t, s: -t.lagrangian(s, -lo, -hi), sign=-1.0)
    J, of_J = bound(lambda t, s: t.J(s, C_V))
    masses = [integral(samples, samples.mu0) for samples in sets]
    shifted = lambda by: Estimate.of([e + by * mass for e, mass in zip(started, masses, strict=True)])
    sandwich, hidden = (shifted(-lo), shifted(hi)), hidden_divergence(list(fluxes))
    pairs = (lagrangian, of_lagrangian), (J, of_J)
    contributions = [[v / (abs(estimate.value) or 1.0) for v in weighted] for estimate, weighted in pairs]
    lagrangian = replace(lagrangian, controller=controller)
    densest = climbed_from(occupation, mu, states, ascents).value
    return ClosedLoopBounds(
        lagrangian, J, C_V, eps_hi, eps_lo, below, sandwich, hidden, contributions, densest, occupation, how, own.sought
    )
