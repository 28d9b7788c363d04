r"""The generator `L^u V = grad V . (a + B u) + D : hess V`, the rate at which `V` changes along the system in the mean, and
what is made of it; `D = sigma sigma^T / 2` is there where there is noise.

Every loss and every bound is a mean or a supremum of two constraint violations: the slack of the Hamilton-Jacobi-Bellman
equation for `V`, and the residual of Liouville's (with noise Fokker and Planck's) equation, the adjoint one, for `(w, mu)`.
Both are written here, once.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ocp_torch.maths.batch_jet import batch_jet
from ocp_torch.maths.jets import Field, Jet, chunked_jet, control_flux_divergence
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


def hjb_slack(value, state_cost, transport, conjugate):
    r"""`Q = V - f - L^0 V / rho + R*(-B^T grad V / rho)` from its four terms, ``(N,)``: `V` is a subsolution where `Q <= 0`.

    The terms are tensors, NumPy arrays or Taylor models. ``transport``, the third, is `None` where `L^0 = 0`, or where
    ``value`` is already `V - L^0 V / rho`.
    """
    free = value - state_cost if transport is None else value - state_cost - transport
    return free + conjugate


def pull_back(B: Any, gradient: Any) -> Any:
    """`B^T grad V`, ``(N, m)``."""
    if isinstance(B, Tensor):  # a matrix product takes a fraction of the time of the sum below
        return torch.einsum("ndm,nd->nm", B, gradient)
    return (B * gradient[..., None]).sum(-2)


@dataclass(frozen=True)
class Generator:
    r"""`L^u` of a problem of discount ``rho`` and control cost ``cost`` at `N` states, and its adjoint.

    ``data`` are the problem's Samples there. The methods up to `reduced_cost` also serve other arithmetics: ``data`` may be
    anything with `f`, `a` (`None` for no drift), `B` and `noise` as NumPy arrays or Taylor models, and needs no ``cost``.
    Jets are to be those of `jet`, which has the curvature where there is noise. Methods of Liouville's equation raise
    `InputError` where the Samples have no divergences.
    """

    data: Samples | Any
    rho: float
    cost: PowerCost | Any = None

    @classmethod
    def of(cls, problem: Problem, samples: Samples) -> "Generator":
        """The generator of ``problem`` at ``samples`` of it."""
        return cls(samples, problem.discount, problem.control_cost)

    def jet(self, field: Field) -> Jet:
        """The jet of a scalar ``field`` at the samples."""
        return batch_jet(field, self.data.x, self.data.noise)

    def chunked_jet(self, field: Field) -> Jet:
        """`jet` at many samples, without a graph."""
        return chunked_jet(field, self.data.x, self.data.noise)

    def advection(self, V: Jet) -> Any:
        """`grad V . a`, ``(N,)``."""
        return (V.gradient * self.data.a).sum(-1)

    def uncontrolled(self, V: Jet) -> Any:
        """`L^0 V = grad V . a + D : hess V`, ``(N,)``."""
        if V.curvature is None:
            if self.data.noise is not None:
                raise TypeError("where there is noise the jet of V must have its curvature: take it by Generator.jet")
            return self.advection(V)
        return V.curvature if self.data.a is None else self.advection(V) + V.curvature

    def transport(self, V: Jet) -> Any:
        """`L^0 V / rho`, ``(N,)``; `None` where there is neither drift nor noise."""
        return None if self.data.a is None and self.data.noise is None else self.uncontrolled(V) / self.rho

    def push(self, V: Jet) -> Any:
        """`-B^T grad V / rho`, ``(N, m)``, of which `grad R*` is the best control against `V` (Proposition 2)."""
        return -pull_back(self.data.B, V.gradient) / self.rho

    def reduced_cost(self, V: Jet) -> Any:
        """`f - V + L^0 V / rho`, ``(N,)``: the cost of a unit of uncontrolled mass, less what the multiplier `V` pays."""
        return self.data.f - V.value + self.transport(V)

    def __call__(self, V: Jet, u: Tensor) -> Tensor:
        """`L^u V = grad V . (a + B u) + D : hess V`, ``(N,)``."""
        return self.uncontrolled(V) + self.controlled(V, u)

    def controlled(self, V: Jet, u: Tensor) -> Tensor:
        """`L^u V - L^0 V = grad V . B u`, ``(N,)``."""
        return (pull_back(self.data.B, V.gradient) * u).sum(dim=-1)

    def hjb_slack(self, V: Jet) -> Tensor:
        """`Q` of `hjb_slack`, ``(N,)``."""
        conjugate = self.cost.conjugate(self.push(V))
        return hjb_slack(V.value, self.data.f, self.transport(V), conjugate)

    def bellman_slack(self, V: Jet, u: Tensor) -> Tensor:
        """`Q_u = V - f - R(u) - L^u V / rho`, ``(N,)``: 0 for `V = V^u`, and never above `Q`."""
        return V.value - self.data.f - self.cost.cost(u) - self(V, u) / self.rho

    def multiplier_term(self, V: Jet, mu: Tensor, w: Tensor) -> Tensor:
        """`-V mu + (L^0 V mu + grad V . B w) / rho`, ``(N,)``: what the multiplier `V` charges for `mu` and `w`."""
        return (self.uncontrolled(V) * mu + self.controlled(V, w)) / self.rho - V.value * mu

    def control_inflow(self, control_density: Field) -> tuple[Tensor, Tensor]:
        """`w` ``(N, m)`` and `mu0 - div(B w) / rho` ``(N,)``: the mass that starts at a state and that control brings."""
        _, div_B = self.data.require_divergences("the primal objective")
        w, flux = control_flux_divergence(control_density, self.data.x, self.data.B, div_B)
        return w, self.data.mu0 - flux / self.rho

    def occupation_outflow(self, log_occupation: Field) -> tuple[Tensor, Tensor]:
        """`mu` and `mu + (div(a mu) - div div(D mu)) / rho`, both ``(N,)``: the latter is the mass that is discounted, and
        that drift and noise carry away.

        `control_inflow` less this is the residual `r = mu0 - mu - (div(a mu + B w) - div div(D mu)) / rho`.
        """
        mu, outflow, _ = self.occupation_flux(log_occupation)
        return mu, outflow

    def occupation_flux(self, log_occupation: Field) -> tuple[Tensor, Tensor, Tensor]:
        """`mu` and the outflow of `occupation_outflow`, and the flux `a mu - div(D mu)` ``(N, d)`` that carries the mass."""
        div_a, _ = self.data.require_divergences("the primal objective")
        log_mu = self.jet(log_occupation)
        mu = log_mu.value.exp()
        carried = div_a + self.advection(log_mu)
        if self.data.noise is not None:
            bent = log_mu.curvature + 0.5 * pull_back(self.data.noise, log_mu.gradient).square().sum(-1)
            carried = carried - self._spread(torch.ones_like(mu), log_mu.gradient, bent)
        return mu, mu * (1.0 + carried / self.rho), self._flux(mu, mu.unsqueeze(-1) * log_mu.gradient)

    def drift_flux(self, occupation: Field) -> tuple[Tensor, Tensor, Tensor]:
        """`mu` ``(N,)``, `div F` ``(N,)`` and `F = a mu - div(D mu)` ``(N, d)`` of the field `mu` itself, which may be 0."""
        div_a, _ = self.data.require_divergences("J")
        mu = self.jet(occupation)
        carried = mu.value * div_a + self.advection(mu)
        if mu.curvature is not None:
            carried = carried - self._spread(mu.value, mu.gradient, mu.curvature)
        return mu.value, carried, self._flux(mu.value, mu.gradient)

    def liouville_residual(
        self, control_density: Field, occupation: Field, still: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`w` ``(N, m)``, `mu` and `r = mu0 - mu - (div(a mu + B w) - div div(D mu)) / rho`, both ``(N,)``, of the field `mu`
        itself, which may be 0; ``still`` says that there is neither drift nor noise."""
        w, inflow = self.control_inflow(control_density)
        mu, drifted = (occupation(self.data.x), 0.0) if still else self.drift_flux(occupation)[:2]
        return w, mu, inflow - mu - drifted / self.rho

    def _flux(self, value: Tensor, gradient: Tensor) -> Tensor:
        """`a mu - div(D mu)`, ``(N, d)``."""
        flux, sigma = value.unsqueeze(-1) * self.data.a, self.data.noise
        if sigma is None:
            return flux
        div_D, _ = self.data.noise_divergences
        return flux - value.unsqueeze(-1) * div_D - 0.5 * (sigma @ pull_back(sigma, gradient).unsqueeze(-1)).squeeze(-1)

    def _spread(self, value: Tensor, gradient: Tensor, curvature: Tensor) -> Tensor:
        """`div div(D mu) = D : hess mu + 2 div D . grad mu + mu div div D`, ``(N,)``, from `mu`, `grad mu` and `D : hess mu`;
        or this over `mu`, from all three over `mu`."""
        div_D, div_div_D = self.data.noise_divergences
        return curvature + 2.0 * (div_D * gradient).sum(-1) + value * div_div_D

    def primal_integrand(self, w: Tensor, mu: Tensor, residual: Tensor, value_bound: float) -> Tensor:
        """The integrand of `J`, `f mu + mu R(w/mu) + C_V max(residual, 0)`, ``(N,)``; `f mu` counts as 0 where `f = 0`."""
        running = torch.where(self.data.f > 0, self.data.f * mu, 0.0) + self.cost.perspective(w, mu)
        return running + value_bound * residual.clamp_min(0.0)
