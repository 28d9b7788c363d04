r"""D(M) with the best constant in `V`: what comes closest to the bound without `M`."""

import torch
from torch import Tensor

from ocp_torch.fields.fields import VALUE, Fields
from ocp_torch.maths.quantiles import upper_quantile
from ocp_torch.objectives.objective import Objective, Phase
from ocp_torch.problems.samples import Samples


class LevelledDual(Objective):
    r"""Maximise `max_c F_M(V - c) = E[V mu0] - CVaR(Q)`, the CVaR being the mean of the largest slacks, those on the part
    `1 / M` of the torus (Rockafellar and Uryasev, 2000).

    It is concave in `V` as `F_M` is, does not feel a constant in `V`, and tends to `E[V mu0] - sup Q` as `M` grows. States
    that `penalty_weight` leaves out are taken to have smaller slacks than those.
    """

    players = {"value": (VALUE,)}

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        M, V = phase.constants.M, fields.value
        weight = samples.weight if samples.penalty_weight is None else samples.penalty_weight
        judged, start = weight != 0.0, samples.take(samples.weight * samples.mu0 != 0.0)
        tail, weight = samples.take(judged), weight[judged]
        with torch.no_grad():
            generator = self.generator(tail)
            slack = generator.hjb_slack(generator.chunked_jet(V))
            level = upper_quantile(slack, weight, len(samples) / (M * len(tail)))
        # At the best level the loss does not change with it to first order; and no gradient comes from where Q is below it.
        # What is not a number is not below, and is met by whoever looks at the loss.
        above = ~(slack < level)
        generator = self.generator(tail.take(above))
        excess = weight[above] * (generator.hjb_slack(generator.jet(V)) - level).clamp_min(0.0)
        paid = start.weight * V(start.x) * start.mu0
        return {"value": level + (M * excess.sum() - paid.sum()) / len(samples)}
