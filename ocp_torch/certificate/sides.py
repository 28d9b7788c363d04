r"""The two sides of the certificate that need no simulation: `F_M` and the shifted bound below; `J` and `G` above."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.checks.hidden import Flux, Hidden, hidden_divergence
from ocp_torch.certificate.checks.tails import rarity, widened
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.certificate.lower.mollified import mollified_shift
from ocp_torch.certificate.lower.recombined import recombined
from ocp_torch.certificate.lower.shifted import Shift, slack_parts
from ocp_torch.control.policies import Density
from ocp_torch.maths.jets import CHUNK, Field
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


@dataclass(frozen=True)
class LowerSide:
    """`F_M` rests on `M` and the per-set `E[V mu0]` and `E[max(Q, 0)]`; ``own`` and ``best`` on suprema of slack.

    ``own`` is the shifted bound of a multiple of `V` itself, ``best`` that or the one of a function made of `V`.
    """

    M: float
    initial: list[float]
    violation: list[float]
    own: Shift
    best: Shift
    rare: float = 0.0  # by how much E[max(Q, 0)] may be off because few states carry it, where that matters

    @property
    def F_M(self) -> Estimate:
        found = Estimate.of([e - self.M * v for e, v in zip(self.initial, self.violation, strict=True)])
        return replace(found, bias=self.M * self.rare) if self.rare > 0.0 else found

    @property
    def shifted(self) -> Estimate:
        return self.best.estimate


def lower_side(
    problem: Problem,
    value: Field,
    sets: list[Samples],
    M: float,
    ascents: int = 32,
    search: bool = False,
    seed: int = 0,
    odd: Tensor | None = None,
) -> LowerSide:
    r"""`F_M(V) = E[V mu0 - M max(Q, 0)]` (section 4.1) and the shifted bound (`ocp_torch.certificate.lower.shifted`).

    With ``search`` the latter is sought among functions made of `V` too, which takes many times as long: with its last
    layer chosen anew (`recombined`, on states of ``seed``), and averages over neighbours of the better of the two
    (`mollified`). Suprema are sought at the states ``odd`` ``(K, d)`` too.
    """
    beside = [] if odd is None or not len(odd) else [Samples.of(problem, odd, divergences=False)]
    shift = lambda v, p: Shift.of(problem, v, sets, p, ascents, beside=slack_parts(problem, v, beside))
    parts = slack_parts(problem, value, sets)
    violation = [integral(s, p.slack(1.0).clamp_min(0.0)) for s, p in zip(sets, parts, strict=True)]
    own = best = shift(value, parts)
    if search:
        other = recombined(problem, value, seed)
        if other is not None:
            others = slack_parts(problem, other, sets)
            tried = replace(shift(other, others), name="V recombined")
            if tried.bound > own.bound:
                value, parts, best = other, others, tried
        best = mollified_shift(problem, value, sets, parts, ascents, best, beside)
    spread = torch.cat([s.weight * p.slack(1.0).clamp_min(0.0) for s, p in zip(sets, parts, strict=True)])
    rare = rarity(spread, sum(own.initial) / len(own.initial) / M)
    return LowerSide(M, own.initial, violation, own, best, rare)


class UpperSide(NamedTuple):
    """`J`, `G` where there is no drift, and a divergence that neither sees, if one was found: they stand without."""

    J: Estimate
    G: Estimate | None
    hidden: Hidden | None
    contributions: list[list[torch.Tensor]] = []  # of `J` and `G`, as parts of each


def upper_side(
    problem: Problem, control_density: Field, occupation: Density, sets: list[Samples], C_V: float
) -> UpperSide:
    r"""`J(w, mu) = E[(f + R(w/mu)) mu + C_V max(mu0 - mu - div(a mu + B w)/rho, 0)]` and, without drift, `G = min_mu J`.

    `OPT <= J` for every `w` and `mu >= 0` once `C_V >= sup V*`; `Perf(w/mu) <= J` once `C_V >= sup V^u` (Proposition 6).
    """
    fluxes, of = [], {"J": [], "G": []}
    for samples in sets:
        parts = [_upper_integrands(problem, control_density, occupation, s, C_V) for s in samples.split(CHUNK)]
        of["J"].append(samples.weight * torch.cat([j for j, *_ in parts]))
        if problem.driftless:
            of["G"].append(samples.weight * torch.cat([g for _, g, *_ in parts]))
        moved = (torch.cat(columns) / problem.discount for columns in list(zip(*parts, strict=True))[2:])
        fluxes.append(Flux(samples.x, samples.weight, *moved))
    means = {
        name: widened(Estimate.of([float(v.mean()) for v in values]), values) for name, values in of.items() if values
    }
    parts_of = [[v / (abs(means[name].value) or 1.0) for v in of[name]] for name in means]
    return UpperSide(means["J"], means.get("G"), hidden_divergence(fluxes), parts_of)


@torch.no_grad()
def _upper_integrands(problem, control_density, occupation, samples: Samples, C_V: float):
    """The integrands of `J` and, without drift, `G`; `div(a mu + B w)` and `a mu + B w`."""
    cost, rho = problem.control_cost, problem.discount
    generator = Generator.of(problem, samples)
    w, inflow = generator.control_inflow(control_density)
    spread, pushed = rho * (samples.mu0 - inflow), torch.einsum("ndm,nm->nd", samples.B, w)
    if problem.driftless:
        mu = occupation(samples.x)
        # An infinite mu stands still at no cost where f = 0: the closed minimum has that limit, J needs the number.
        J = torch.where(
            torch.isfinite(mu),
            generator.primal_integrand(w, torch.where(torch.isfinite(mu), mu, 1.0), inflow - mu, C_V),
            cost.primal_minimum(w, samples.f, C_V, inflow),
        )
        return J, cost.primal_minimum(w, samples.f, C_V, inflow), spread, pushed
    mu, drifted = generator.drift_flux_divergence(occupation)
    J = generator.primal_integrand(w, mu, inflow - mu - drifted / rho, C_V)
    return J, None, spread + drifted, pushed + mu.unsqueeze(-1) * samples.a
