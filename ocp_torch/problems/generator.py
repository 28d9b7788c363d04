r"""The generator `L^u V = grad V . (a + B u)`, the rate at which `V` changes along the system, and what is made of it.

Every loss and every bound is a mean or a supremum of two constraint violations: the slack of the Hamilton-Jacobi-Bellman
equation for `V`, and the residual of Liouville's equation, the adjoint one, for `(w, mu)`. They are written here, once.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ocp_torch.maths.jets import Field, Jet, control_flux_divergence, jet
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


def hjb_slack(value, state_cost, transport, conjugate):
    r"""`Q = V - f - L^0 V / rho + R*(-B^T grad V / rho)` from its four terms, ``(N,)``: `V` is a subsolution where `Q <= 0`.

    The terms are tensors, NumPy arrays or Taylor models. ``transport``, the third, is `None` where there is no drift, and
    where ``value`` is `V - L^0 V / rho` already.
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
    anything with `f`, `a` (`None` for no drift) and `B` as NumPy arrays or Taylor models, and needs no ``cost``. Methods of
    Liouville's equation raise `InputError` where the Samples have no divergences.
    """

    data: Samples | Any
    rho: float
    cost: PowerCost | Any = None

    @classmethod
    def of(cls, problem: Problem, samples: Samples) -> "Generator":
        """That of ``problem`` at ``samples`` of it."""
        return cls(samples, problem.discount, problem.control_cost)

    def uncontrolled(self, V: Jet) -> Any:
        """`L^0 V = grad V . a`, ``(N,)``."""
        return (V.gradient * self.data.a).sum(-1)

    def transport(self, V: Jet) -> Any:
        """`L^0 V / rho`, ``(N,)``; `None` where there is no drift."""
        return None if self.data.a is None else self.uncontrolled(V) / self.rho

    def push(self, V: Jet) -> Any:
        """`-B^T grad V / rho`, ``(N, m)``, of which `grad R*` is the best control against `V` (Proposition 2)."""
        return -pull_back(self.data.B, V.gradient) / self.rho

    def reduced_cost(self, V: Jet) -> Any:
        """`f - V + L^0 V / rho`, ``(N,)``: cost of a unit of uncontrolled mass, less what the multiplier `V` pays."""
        return self.data.f - V.value + self.transport(V)

    def __call__(self, V: Jet, u: Tensor) -> Tensor:
        """`L^u V = grad V . (a + B u)`, ``(N,)``."""
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
        """`-V mu + grad V . (a mu + B w) / rho`, ``(N,)``: what the multiplier `V` charges for `mu` and `w`."""
        return (self.uncontrolled(V) * mu + self.controlled(V, w)) / self.rho - V.value * mu

    def control_inflow(self, control_density: Field) -> tuple[Tensor, Tensor]:
        """`w` ``(N, m)`` and `mu0 - div(B w) / rho` ``(N,)``: the mass that starts there, and that control brings."""
        _, div_B = self.data.require_divergences("the primal objective")
        w, flux = control_flux_divergence(control_density, self.data.x, self.data.B, div_B)
        return w, self.data.mu0 - flux / self.rho

    def occupation_outflow(self, log_occupation: Field) -> tuple[Tensor, Tensor]:
        """`mu` and `mu + div(a mu) / rho`, both ``(N,)``: the mass that is discounted, and that drift carries away.

        `control_inflow` less this is Liouville's residual `r = mu0 - mu - div(a mu + B w) / rho`.
        """
        div_a, _ = self.data.require_divergences("the primal objective")
        log_mu = jet(log_occupation, self.data.x)
        mu = log_mu.value.exp()
        return mu, mu * (1.0 + (div_a + self.uncontrolled(log_mu)) / self.rho)

    def drift_flux_divergence(self, occupation: Field) -> tuple[Tensor, Tensor]:
        """`mu` and `div(a mu)`, both ``(N,)``, where `mu` itself is the field, which may be 0."""
        div_a, _ = self.data.require_divergences("J")
        mu = jet(occupation, self.data.x)
        return mu.value, mu.value * div_a + self.uncontrolled(mu)

    def primal_integrand(self, w: Tensor, mu: Tensor, residual: Tensor, value_bound: float) -> Tensor:
        """The integrand of `J`: `f mu + mu R(w/mu) + C_V max(residual, 0)`, ``(N,)``; 0 for `f mu` where `f = 0`."""
        running = torch.where(self.data.f > 0, self.data.f * mu, 0.0) + self.cost.perspective(w, mu)
        return running + value_bound * residual.clamp_min(0.0)
