r"""The primal-dual saddle, PD (section 6 of the paper)."""

from __future__ import annotations

from torch import Tensor

from ocp_torch import calculus, control_laws, formulas
from ocp_torch.fields.fields import CONTROL_DENSITY, VALUE, Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.samples import Samples


class Saddle(Objective):
    r"""`sup_V inf_w E[V mu0 + grad V . B w / rho + S_M(w, f - V + grad V . a / rho)]`, with `S_M` of Lemma 3.

    Convex in `w`, concave in `V`, and needs no divergence of the problem.
    """

    players = {"value": (VALUE,), "density": (CONTROL_DENSITY,)}
    occupation = control_laws.SADDLE

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        value, gradient = calculus.value_and_gradient(fields.value, samples.x)
        w = fields.control_density(samples.x)
        pushed = (formulas.pull_back(samples, gradient) * w).sum(dim=-1) / self.rho
        beta = samples.f - value + formulas.along(samples, gradient) / self.rho
        psi = samples.mean(value * samples.mu0 + pushed + self.cost.saddle_minimum(w, beta, self.bounds.M))
        return {"value": -psi, "density": psi}
