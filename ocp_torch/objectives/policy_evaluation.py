r"""Policy evaluation by least squares: `V^u` and `mu^u` of a closed loop, two linear equations with smooth losses."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.fields.fields import LOG_OCCUPATION, VALUE, Fields
from ocp_torch.maths import jets
from ocp_torch.objectives.objective import Objective
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.samples import Samples


class PolicyEvaluation(Objective):
    r"""`min_mu E[r^2]` and, where a value function is wanted too, `min_V E[(Q_u / s)^2]`, on samples of a `ClosedLoop`.

    `r = mu0 - mu (1 + (grad log mu . g_u + div g_u) / rho)` is the Liouville residual, `Q_u` the Bellman slack and `s` the
    scale of the `V` network: the strong forms of P(u) and D(u) (section 5.4 of the paper). The two players do not
    interact; there is no hinge and no game. Where missing mass (`r > 0`) costs the bounds more than surplus, ``price`` is by
    how much more it weighs.
    """

    needs_divergences = True

    def __init__(self, problem: ClosedLoop, constants: Constants, with_value: bool, price: float = 1.0) -> None:
        super().__init__(problem, constants)
        self.price = price
        self.players = {"occupation": (LOG_OCCUPATION,)} | ({"value": (VALUE,)} if with_value else {})

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        generator = self.generator(samples)
        _, outflow = generator.occupation_outflow(fields.log_occupation)
        r = samples.mu0 - outflow
        losses = {"occupation": samples.mean(torch.where(r > 0.0, self.price, 1.0) * r.square())}
        if "value" in self.players:
            slack = generator.hjb_slack(jets.jet(fields.value, samples.x))
            losses["value"] = samples.mean((slack / getattr(fields.value, "scale", 1.0)).square())
        return losses
