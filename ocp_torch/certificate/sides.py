r"""The two sides of the certificate that need no simulation: `F_M` and the shifted bound below; `J` and `G` above."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch import calculus, formulas
from ocp_torch.calculus import Field
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.control_laws import Density
from ocp_torch.extremum import Extremum, supremum
from ocp_torch.problems.problem import Problem
from ocp_torch.samples import Samples

# States evaluated at once: what fits the cache is fastest.
CHUNK = 1024


@dataclass(frozen=True)
class LowerSide:
    """`F_M` rests on `M`, `shifted` on the supremum of the slack; per point set, `E[V mu0]` and `E[max(Q, 0)]`."""

    M: float
    initial: list[float]
    violation: list[float]
    largest_slack: Extremum

    @property
    def F_M(self) -> Estimate:
        return Estimate.of([e - self.M * v for e, v in zip(self.initial, self.violation, strict=True)])

    @property
    def shifted(self) -> Estimate:
        return Estimate.of([e - max(self.largest_slack.value, 0.0) for e in self.initial])


def slack_function(problem: Problem, value: Field):
    """`x -> Q(x)` for the whole torus, differentiable in `x` where the problem is."""

    def slack(x: Tensor) -> Tensor:
        samples = Samples.of(problem, x, divergences=False) if not x.requires_grad else _live(problem, x)
        v, gradient = calculus.value_and_gradient(value, x)
        return formulas.hjb_slack(samples, v, gradient, problem.control_cost, problem.discount)

    return slack


def _live(problem: Problem, x: Tensor) -> Samples:
    """Samples whose data carry derivatives in `x`; only suprema over `x` want that."""
    one = torch.ones_like(x[:, 0])
    return Samples(x, problem.state_cost(x), problem.drift(x), problem.control_matrix(x), one, one)


def lower_side(problem: Problem, value: Field, sets: list[Samples], M: float, ascents: int = 32) -> LowerSide:
    r"""`F_M(V) = E[V mu0 - M max(Q, 0)]` (section 4.1) and `E[V mu0] - max_x max(Q, 0)`.

    The second needs no `M`: `V` minus its largest positive slack is a subsolution, because a constant shifts `Q` by
    itself. Its supremum is sampled on all of ``sets`` and climbed, hence an estimate.
    """
    violation, initial, worst = [], [], None
    for samples in sets:
        v, gradient = chunked_gradient(value, samples.x)
        slack = formulas.hjb_slack(samples, v, gradient, problem.control_cost, problem.discount)
        initial.append(integral(samples, v * samples.mu0))
        violation.append(integral(samples, slack.clamp_min(0.0)))
        top = slack.topk(min(ascents, len(slack)))
        found = torch.cat([top.values.unsqueeze(-1), samples.x[top.indices]], dim=-1)
        worst = found if worst is None else torch.cat([worst, found])
    start = worst[worst[:, 0].topk(min(ascents, len(worst))).indices, 1:]
    largest = supremum(slack_function(problem, value), start, ascents=ascents)
    largest = Extremum(largest.value, largest.x, sum(len(s) for s in sets), largest.ascents)
    return LowerSide(M, initial, violation, largest)


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
