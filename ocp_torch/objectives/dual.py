r"""The dual with an exact penalty, D(M) (section 4.1 of the paper), and the bound without `M` where no `M` will do."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ocp_torch import calculus, formulas
from ocp_torch.bounds import Bounds
from ocp_torch.errors import require_number
from ocp_torch.fields.fields import VALUE, Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.problems.problem import Problem
from ocp_torch.samples import Samples

# Where no `M` is known: the part of `M` that a round starts with, and the part of the round in which it grows.
LEAST_WEIGHT, GROWTH = 1.0 / 20.0, 0.7
# In the rest of it the largest slack of a batch shares the weight with the mean: the bound without `M` was 0.186 % below OPT
# instead of 0.207 % on the 2-d torus, 0.024 % instead of 0.037 % on a smooth 4-d problem, and no worse on the arm. Alone it
# was better on smooth problems and worse at kinks.
LARGEST_PART = 0.5
# How smooth that maximum is, at first and at the end, in distances from the median of the slack to its 99 % quantile.
SMOOTHNESS = (2.0, 0.5)


class Dual(Objective):
    r"""Maximise `F_M(V) = E[V mu0 - M max(Q, 0)]`: at most `OPT` for every `V` once `M >= sup mu*` (Proposition 3).

    With ``residual`` `k > 0` also `-(k/s) E[Q^2]`, `s` the scale of the `V` network. `V*` is optimal for that too, since
    `Q = 0` almost everywhere there; unlike the hinge it has a gradient on both sides of the solution. The paper's dual is
    ``residual = 0``.

    Where no `M` is known to be large enough (`Bounds.unbounded`) what is certified is `E[V mu0] - sup Q`. A large
    `M` keeps the supremum small; but from the start it ends in subsolutions far below `V*`, which have no gradient. So `M`
    grows along a round: first `V` is too high, and then comes down until it is feasible. When it has grown, half of the
    hinge gives way to the smoothed maximum of `Q` over the batch.
    """

    players = {"value": (VALUE,)}

    def __init__(self, problem: Problem, bounds: Bounds, residual: float = 0.3) -> None:
        super().__init__(problem, bounds)
        self.residual = require_number("method.residual", residual, at_least=0.0)

    def losses(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        value, gradient = calculus.value_and_gradient(fields.value, samples.x)
        slack = formulas.hjb_slack(samples, value, gradient, self.cost, self.rho)
        return {"value": value_loss(self, fields, samples, value, slack, self.residual)}


def value_loss(
    objective: Objective, fields: Fields, samples: Samples, value: Tensor, slack: Tensor, residual: float
) -> Tensor:
    """What a value player on its own minimises: `E[M max(Q, 0) + (residual / s) Q^2 - V mu0]`."""
    M, scale, largest = objective.bounds.M, getattr(fields.value, "scale", 1.0), 0.0
    if objective.bounds.unbounded:
        M = M * LEAST_WEIGHT ** max(0.0, 1.0 - objective.progress / GROWTH)
        if objective.progress >= GROWTH:
            late = (objective.progress - GROWTH) / (1.0 - GROWTH)
            M = (1.0 - LARGEST_PART) * M
            largest = LARGEST_PART * smoothed_maximum(slack, SMOOTHNESS[0] ** (1.0 - late) * SMOOTHNESS[1] ** late)
    violation = M * slack.clamp_min(0.0)
    if residual > 0.0:
        violation = violation + residual / scale * slack.square()
    return largest + samples.penalty(violation) - samples.mean(value * samples.mu0)


def smoothed_maximum(slack: Tensor, smoothness: float) -> Tensor:
    """`tau log E exp(Q / tau)` of ``slack`` ``(N,)``, at most its largest value; `tau` is ``smoothness`` times the distance
    from its median to its 99 % quantile, and so follows the size of what is left."""
    median, high = torch.quantile(slack.detach(), torch.tensor([0.5, 0.99]).to(slack))
    tau = (smoothness * (high - median)).clamp_min(torch.finfo(slack.dtype).tiny ** 0.5)
    top = slack.detach().max()  # taken off first: in float32 a large quotient would swallow the logarithm
    return top + tau * (torch.logsumexp((slack - top) / tau, dim=0) - math.log(len(slack)))
