r"""`J` from recorded samples: an expectation over the torus of functions of the data, so a weighted mean of held-out samples.

The closed loop of a controller that is known at every state (`w / mu` of two networks; from `V` where `B` is constant) has
its data at the recorded states too: `f + R(u)`, `a + B u` and, from `div a` and `div B`, its divergence.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.checks.hidden import Hidden
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.control.policies import Policy
from ocp_torch.maths.jets import CHUNK, control_flux_divergence
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.samples import Samples

DENSEST_SAMPLES = 10  # samples of largest fitted density at which the contraction of the flow is checked


@torch.no_grad()
def closed_loop_samples(samples: Samples, policy: Policy, cost: PowerCost) -> Samples:
    """What `ClosedLoop` of ``policy`` would give at the states of ``samples``."""
    pieces = []
    for part in samples.split(CHUNK):
        div_a, div_B = part.require_divergences("the closed loop")
        u, flux = control_flux_divergence(policy, part.x, part.B, div_B)
        flow = part.velocity(u)
        pieces.append(replace(part, f=part.f + cost.cost(u), a=flow, div_a=div_a + flux))
    loop = Samples.concatenate(pieces)
    return replace(loop, B=torch.zeros_like(loop.x).unsqueeze(-1), div_B=torch.zeros_like(loop.x[:, :1]))


class RecordedFit(NamedTuple):
    """`J` of a controller, its ``C_V``, the largest ``mu`` of the fitted density, and what the samples' divergences miss."""

    J: Estimate
    C_V: float
    sup_occupation: float
    hidden: Hidden | None


def highest_occupation(mu: Tensor, loop: Samples, rho: float) -> float:
    """The largest of the fitted densities ``mu`` ``(N,)`` at samples of the closed ``loop``; infinite where the density may
    be unbounded.

    Where a density is largest its gradient is 0, and Liouville's equation says `-div g_u = rho (1 - mu0 / mu) < rho`. Where
    a flow contracts faster at the densest samples, the density has no bound and the fit shows only its lower part, unless
    noise in all directions spreads it.
    """
    top = loop.take(mu.topk(min(DENSEST_SAMPLES, len(mu))).indices)
    if top.noise is not None and float(torch.linalg.matrix_rank(top.noise).min()) == top.x.shape[1]:
        return float(mu.max())
    return float(mu.max()) if float((-top.require_divergences("the closed loop")[0]).max()) < rho else math.inf
