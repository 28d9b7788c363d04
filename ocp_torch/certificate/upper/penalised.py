"""`J`, in which the Liouville residual of `w` and `mu` is penalised, and at the same states `G`, the least over `mu`."""

from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.checks.hidden import Flux, Hidden, hidden_divergence
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.certificate.statistics.tails import widened
from ocp_torch.control.policies import Density
from ocp_torch.maths.jets import CHUNK, Field
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


class DensityBounds(NamedTuple):
    """`J`; `G` where there is neither drift nor noise; a divergence that both miss, if one was found: neither holds then."""

    J: Estimate
    G: Estimate | None
    hidden: Hidden | None
    contributions: list[list[Tensor]]  # weighted integrands of `J` and `G`, over their values


def density_bounds(
    problem: Problem, control_density: Field, occupation: Density, sets: list[Samples], C_V: float
) -> DensityBounds:
    r"""`J(w, mu) = E[(f + R(w/mu)) mu + C_V max(mu0 - mu - div(a mu + B w)/rho, 0)]`, with noise `- div div(D mu)` in the
    divergence; and, with neither drift nor noise, `G = min_mu J`.

    `OPT <= J` for every `w` and `mu >= 0` once `C_V >= sup V*`; `Perf(w/mu) <= J` once `C_V >= sup V^u` (Proposition 6).
    """
    fluxes: list[Flux] = []
    of: dict[str, list[Tensor]] = {"J": [], "G": []} if problem.still else {"J": []}
    for samples in sets:
        parts = [_upper_integrands(problem, control_density, occupation, s, C_V) for s in samples.split(CHUNK)]
        *integrands, spread, pushed = (torch.cat(columns) for columns in zip(*parts, strict=True))
        fluxes.append(Flux(samples.x, samples.weight, spread / problem.discount, pushed / problem.discount))
        for values, integrand in zip(of.values(), integrands, strict=True):
            values.append(samples.weight * integrand)
    means = {name: widened(Estimate.of([float(v.mean()) for v in values]), values) for name, values in of.items()}
    parts_of = [[v / (abs(means[name].value) or 1.0) for v in values] for name, values in of.items()]
    return DensityBounds(means["J"], means.get("G"), hidden_divergence(fluxes), parts_of)


@torch.no_grad()
def _upper_integrands(problem, control_density, occupation, samples: Samples, C_V: float):
    """The integrands of `J` and, without drift and noise, of `G`; the flux's divergence, and the flux."""
    cost, rho = problem.control_cost, problem.discount
    generator = Generator.of(problem, samples)
    w, inflow = generator.control_inflow(control_density)
    spread, pushed = rho * (samples.mu0 - inflow), torch.einsum("ndm,nm->nd", samples.B, w)
    if problem.still:
        mu = occupation(samples.x)
        finite, G = torch.isfinite(mu), cost.primal_minimum(w, samples.f, C_V, inflow)
        # An infinite mu stands still at no cost where f = 0: J has the limit there that the closed form G gives.
        J = generator.primal_integrand(w, torch.where(finite, mu, 1.0), inflow - mu, C_V)
        return torch.where(finite, J, G), G, spread, pushed
    mu, drifted, carried = generator.drift_flux(occupation)
    J = generator.primal_integrand(w, mu, inflow - mu - drifted / rho, C_V)
    return J, spread + drifted, pushed + carried
