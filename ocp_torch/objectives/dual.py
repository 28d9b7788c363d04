r"""The dual with an exact penalty, D(M) (section 4.1 of the paper)."""

from __future__ import annotations

from torch import Tensor

from ocp_torch import calculus, formulas
from ocp_torch.fields.fields import VALUE, Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.samples import Samples


class Dual(Objective):
    r"""Maximise `F_M(V) = E[V mu0 - M max(Q, 0)]`: at most `OPT` for every `V` once `M >= sup mu*` (Proposition 3)."""

    players = {"value": (VALUE,)}

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        value, gradient = calculus.value_and_gradient(fields.value, samples.x)
        slack = formulas.hjb_slack(samples, value, gradient, self.cost, self.rho)
        return {"value": -samples.mean(value * samples.mu0 - self.bounds.M * slack.clamp_min(0.0))}
