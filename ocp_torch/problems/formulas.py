r"""The pointwise quantities every loss and every bound is made of, as functions of field values and Samples.

`slack` and `residual` are the paper's two constraint violations; nothing here knows of training or of networks.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.maths.calculus import Field, control_flux_divergence, directional_derivative
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.samples import Samples


def along(samples: Samples, gradient: Tensor) -> Tensor:
    """`grad V . a`, ``(N,)``."""
    return (gradient * samples.a).sum(dim=-1)


def pull_back(samples: Samples, gradient: Tensor) -> Tensor:
    """`B^T grad V`, ``(N, m)``."""
    return torch.einsum("ndm,nd->nm", samples.B, gradient)


def hjb_slack(samples: Samples, value: Tensor, gradient: Tensor, cost: PowerCost, rho: float) -> Tensor:
    """`Q = V - f - grad V . a / rho + R*(-B^T grad V / rho)`, ``(N,)``: `V` is a subsolution where `Q <= 0`."""
    conjugate = cost.conjugate(-pull_back(samples, gradient) / rho)
    return value - samples.f - along(samples, gradient) / rho + conjugate


def bellman_slack(samples: Samples, value: Tensor, gradient: Tensor, u: Tensor, cost: PowerCost, rho: float) -> Tensor:
    """`Q_u = V - f - R(u) - grad V . (a + B u) / rho`, ``(N,)``: 0 for `V = V^u`, and never above `Q`."""
    pushed = (pull_back(samples, gradient) * u).sum(dim=-1)
    return value - samples.f - cost.cost(u) - (along(samples, gradient) + pushed) / rho


def control_inflow(samples: Samples, control_density: Field, rho: float) -> tuple[Tensor, Tensor]:
    """`w` ``(N, m)`` and `beta = mu0 - div(B w) / rho` ``(N,)``: all of the Liouville residual but `mu` and the drift."""
    _, div_B = samples.require_divergences("the primal objective")
    w, flux = control_flux_divergence(control_density, samples.x, samples.B, div_B)
    return w, samples.mu0 - flux / rho


def occupation_outflow(samples: Samples, log_occupation: Field, rho: float) -> tuple[Tensor, Tensor]:
    """`mu` and `mu + div(a mu) / rho`, both ``(N,)``: what the drift takes from the Liouville residual."""
    div_a, _ = samples.require_divergences("the primal objective")
    log_mu, derivative = directional_derivative(log_occupation, samples.x, samples.a)
    mu = log_mu.exp()
    return mu, mu * (1.0 + (div_a + derivative) / rho)


def primal_integrand(
    samples: Samples, w: Tensor, mu: Tensor, residual: Tensor, cost: PowerCost, value_bound: float
) -> Tensor:
    """The integrand of `J`: `f mu + mu R(w/mu) + C_V max(residual, 0)`, ``(N,)``; 0 for `f mu` where `f = 0`."""
    running = torch.where(samples.f > 0, samples.f * mu, 0.0) + cost.perspective(w, mu)
    return running + value_bound * residual.clamp_min(0.0)


def multiplier_term(samples: Samples, value: Tensor, gradient: Tensor, mu: Tensor, w: Tensor, rho: float) -> Tensor:
    """`-V mu + grad V . (a mu + B w) / rho`, ``(N,)``: what the multiplier `V` charges for `mu` and `w`."""
    transported = along(samples, gradient) * mu + (pull_back(samples, gradient) * w).sum(dim=-1)
    return transported / rho - value * mu
