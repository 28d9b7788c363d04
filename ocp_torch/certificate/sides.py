r"""The two sides of the certificate that need no simulation: `F_M` and the shifted bound below; `J` and `G` above."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch import calculus, formulas
from ocp_torch.calculus import Field
from ocp_torch.certificate.control_variate import integrals
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.certificate.shifted import SlackParts, best_shift, slack_function
from ocp_torch.control_laws import Density
from ocp_torch.extremum import Extremum
from ocp_torch.problems.problem import Problem
from ocp_torch.samples import Samples

__all__ = ["CHUNK", "LowerSide", "chunked_gradient", "lower_side", "slack_function", "upper_side"]

# States evaluated at once: what fits the cache is fastest.
CHUNK = 1024


@dataclass(frozen=True)
class LowerSide:
    """`F_M` rests on `M`, `shifted` on the supremum of the slack of `theta V`; both on per-set `E[V mu0]`, `E[max(Q, 0)]`."""

    M: float
    initial: list[float]
    violation: list[float]
    theta: float
    largest_slack: Extremum

    @property
    def F_M(self) -> Estimate:
        return Estimate.of([e - self.M * v for e, v in zip(self.initial, self.violation, strict=True)])

    @property
    def shifted(self) -> Estimate:
        """`E[theta V mu0] - sup Q_{theta V}`; a negative supremum shifts `V` up."""
        return Estimate.of([self.theta * e - self.largest_slack.value for e in self.initial])


def lower_side(problem: Problem, value: Field, sets: list[Samples], M: float, ascents: int = 32) -> LowerSide:
    r"""`F_M(V) = E[V mu0 - M max(Q, 0)]` (section 4.1) and the shifted bound (`ocp_torch.certificate.shifted`)."""
    violation, started, pieces = [], [], []
    for samples in sets:
        v, gradient = chunked_gradient(value, samples.x)
        parts = SlackParts.of(samples, v, gradient, problem.control_cost, problem.discount)
        started.append(v * samples.mu0)
        violation.append(integral(samples, parts.slack(1.0).clamp_min(0.0)))
        pieces.append(parts)
    initial = integrals([samples.x for samples in sets], started)
    theta, largest = best_shift(problem, value, SlackParts.join(pieces), sum(initial) / len(initial), ascents)
    return LowerSide(M, initial, violation, theta, largest)


def upper_side(
    problem: Problem, control_density: Field, occupation: Density, sets: list[Samples], C_V: float
) -> tuple[Estimate, Estimate | None]:
    r"""`J(w, mu) = E[(f + R(w/mu)) mu + C_V max(mu0 - mu - div(a mu + B w)/rho, 0)]` and, without drift, `G = min_mu J`.

    `OPT <= J` for every `w` and `mu >= 0` once `C_V >= sup V*`; `Perf(w/mu) <= J` once `C_V >= sup V^u` (Proposition 6).
    """
    J, G = [], []
    for samples in sets:
        parts = [_upper_integrands(problem, control_density, occupation, s, C_V) for s in samples.split(CHUNK)]
        J.append(integral(samples, torch.cat([j for j, _ in parts])))
        if problem.driftless:
            G.append(integral(samples, torch.cat([g for _, g in parts])))
    return Estimate.of(J), Estimate.of(G) if G else None


@torch.no_grad()
def _upper_integrands(problem, control_density, occupation, samples: Samples, C_V: float):
    cost, rho = problem.control_cost, problem.discount
    w, inflow = formulas.controlled_inflow(samples, control_density, rho)
    if problem.driftless:
        mu = occupation(samples.x)
        # An infinite mu stands still at no cost where f = 0: the closed minimum has that limit, J needs the number.
        J = torch.where(
            torch.isfinite(mu),
            formulas.primal_integrand(samples, w, torch.where(torch.isfinite(mu), mu, 1.0), inflow - mu, cost, C_V),
            cost.primal_minimum(w, samples.f, C_V, inflow),
        )
        return J, cost.primal_minimum(w, samples.f, C_V, inflow)
    div_a, _ = samples.require_divergences("J")
    mu, derivative = calculus.directional_derivative(occupation, samples.x, samples.a)
    residual = inflow - mu - (mu * div_a + derivative) / rho
    return formulas.primal_integrand(samples, w, mu, residual, cost, C_V), None


@torch.no_grad()
def chunked_gradient(value: Field, x: Tensor, chunk: int = CHUNK) -> tuple[Tensor, Tensor]:
    """`V` and `grad V` at many states."""
    pairs = [calculus.value_and_gradient(value, part) for part in x.split(chunk)]
    return torch.cat([v for v, _ in pairs]), torch.cat([g for _, g in pairs])
