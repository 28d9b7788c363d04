r"""Policy evaluation by least squares: `V^u` and `mu^u` of a closed loop, two linear equations with smooth losses."""

import torch
from torch import Tensor

from ocp_torch.fields.fields import LOG_OCCUPATION, VALUE, Fields
from ocp_torch.objectives.objective import Objective, Phase
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.samples import Samples


class PolicyEvaluation(Objective):
    r"""`min_mu E[r^2]` and, where a value function is wanted too, `min_V E[(Q_u / s)^2]`, on samples of a `ClosedLoop`.

    `r = mu0 - mu (1 + (grad log mu . g_u + div g_u) / rho)`, and what noise adds, is the Liouville residual, `Q_u` the
    Bellman slack and `s` the scale of the `V` network: the strong forms of P(u) and D(u) (section 5.4 of the paper).
    The two players do not interact; there is no hinge and no game. Missing mass (`r > 0`) may cost the bounds more, or
    less, than surplus: ``positive_weight`` is the weight of `r^2` there, which is 1 elsewhere. And `r^2` is divided by
    `1 + mu`, as data, since fits to a density of high peaks else collapse to `mu = 0`, whose squares are smaller (with noise
    dubins' Lagrangian bound was 130 % above Perf undivided, and 5 % divided).
    """

    def __init__(self, problem: ClosedLoop, with_value: bool, positive_weight: float = 1.0) -> None:
        super().__init__(problem)
        self.positive_weight = positive_weight
        self.players = {"occupation": (LOG_OCCUPATION,)} | ({"value": (VALUE,)} if with_value else {})

    def needs_divergences(self, phase: Phase) -> bool:
        return True

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        generator = self.generator(samples)
        mu, outflow = generator.occupation_outflow(fields.log_occupation)
        r = samples.mu0 - outflow
        squares = torch.where(r > 0.0, self.positive_weight, 1.0) * r.square() / (1.0 + mu.detach())
        losses = {"occupation": samples.mean(squares)}
        if "value" in self.players:
            slack = generator.hjb_slack(generator.jet(fields.value))
            losses["value"] = samples.mean((slack / getattr(fields.value, "scale", 1.0)).square())
        return losses
