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

    This is concave in `V` as `F_M` is, does not depend on a constant in `V`, and tends to `E[V mu0] - sup Q` as `M` grows.
    States that `penalty_weight` leaves out are taken to have slacks below those largest ones.
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
        # Slacks below the level have no gradient; a NaN is not below, so that it shows in the loss. States at the level share
        # what those above leave of the weight 1: with another sum the constant in V would move at every step (a pendulum's
        # bound was then 2.958 after 2,100 steps, and 2.973 so).
        above = ~(slack < level)
        share = M * weight[above] / len(samples)
        higher = slack[above] > level
        share = torch.where(higher, share, (1.0 - share[higher].sum()) / (~higher).sum())
        generator = self.generator(tail.take(above))
        paid = start.weight * V(start.x) * start.mu0
        return {"value": (share * generator.hjb_slack(generator.jet(V))).sum() - paid.sum() / len(samples)}
