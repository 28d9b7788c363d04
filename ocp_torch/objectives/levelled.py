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

    It is concave in `V` as `F_M` is, does not feel a constant in `V`, and tends to `E[V mu0] - sup Q` as `M` grows.
    """

    players = {"value": (VALUE,)}

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        M, V = phase.constants.M, fields.value
        with torch.no_grad():
            generator = self.generator(samples)
            slack = generator.hjb_slack(generator.chunked_jet(V))
            level = upper_quantile(slack, samples.weight, 1.0 / M)
        # At the best level the loss does not change with it to first order; and no gradient comes from where Q is below it.
        # What is not a number is not below, and is met by whoever looks at the loss.
        high, start = samples.take(~(slack < level)), samples.take(samples.mu0 != 0.0)
        generator = self.generator(high)
        excess = high.weight * (generator.hjb_slack(generator.jet(V)) - level).clamp_min(0.0)
        paid = start.weight * V(start.x) * start.mu0
        return {"value": level + (M * excess.sum() - paid.sum()) / len(samples)}
