"""Expectation maximisation: a `Mixture` fitted to weighted states, whose displacements are taken the short way round."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.maths.mixtures import WIDEST, Mixture, effective_part
from ocp_torch.maths.seeds import fixed_generator

# Components at most, which begin around states drawn by weight, and steps.
COMPONENTS, STEPS = 12, 12
# States that a fit uses at most, the heaviest, and the weight relative to the largest below which a state does not matter.
MOST, NEGLIGIBLE = 2**13, 1e-12
# The largest share a component begins with, before all are scaled to FITTED_PART; the share below which one is dropped.
LARGEST_START, LEAST_SHARE = 0.95, 1e-4
# Part of the whole that is in components; the rest stays uniform, for what the states have missed.
FITTED_PART = 0.9
# A fitted standard deviation above this is taken for uniform, whose own is 0.289; none is below the smallest.
SPREAD, SMALLEST = 0.22, 1e-9


def fitted_to(x: Tensor, weights: Tensor, density: Tensor) -> Mixture:
    """The mixture fitted to states ``(N, d)`` with ``weights`` ``(N,)``, both its components and its uniform part.

    ``density`` ``(N,)`` is that of the states: it says how far apart they are, and no component is much narrower than that.
    """
    dim = x.shape[1]
    spacing = (len(x) * density) ** (-1.0 / dim)
    used = weights.topk(min(MOST, len(weights))).indices
    used = used[weights[used] > NEGLIGIBLE * weights.max()]
    x, weights, spacing = x[used], weights[used] / weights[used].sum(), spacing[used]
    generator = fixed_generator()
    start = torch.multinomial(weights, COMPONENTS, replacement=True, generator=generator)
    centres = x[start].unique(dim=0)
    away = _displacement(x, centres)
    nearest = away.square().sum(dim=-1).argmin(dim=1)
    own = away[torch.arange(len(x)), nearest].square()
    widths = torch.stack([_width(weights * (nearest == k), own, spacing) for k in range(len(centres))])
    shares = torch.stack([(weights * (nearest == k)).sum() for k in range(len(centres))]).clamp_max(LARGEST_START)
    mixture = Mixture(FITTED_PART * shares / shares.sum(), centres, widths)
    for _ in range(STEPS):
        parts = mixture.components(x) * mixture.shares
        parts = parts / (parts.sum(dim=1, keepdim=True) + 1.0 - mixture.shares.sum()) * weights.unsqueeze(-1)
        shares = parts.sum(dim=0)
        alive = shares > LEAST_SHARE
        if not alive.any():
            return Mixture.uniform(dim)
        parts, shares, centres = parts[:, alive], shares[alive], mixture.centres[alive]
        away = _displacement(x, centres)
        move = (parts.unsqueeze(-1) * away).sum(dim=0) / shares.unsqueeze(-1)
        spread = (away - move).square()
        widths = torch.stack([_width(parts[:, k], spread[:, k], spacing) for k in range(len(shares))])
        mixture = Mixture(shares * min(1.0, FITTED_PART / float(shares.sum())), (centres + move).remainder(1.0), widths)
    return mixture


def _displacement(x: Tensor, centres: Tensor) -> Tensor:
    """From each centre to each state the short way round, ``(N, K, d)``."""
    away = x.unsqueeze(1) - centres
    return away - away.round()


def _width(weights: Tensor, squares: Tensor, spacing: Tensor) -> Tensor:
    """Standard deviations ``(d,)`` of weighted states, with that of a kernel as wide as half their ``spacing``."""
    total = weights.sum().clamp_min(1e-300)
    variance = (weights.unsqueeze(-1) * squares).sum(dim=0) / total
    own = (weights * spacing).sum() / total
    width = (variance + (0.5 * own / max(1.0, len(weights) * effective_part(weights)) ** 0.5) ** 2).sqrt()
    return torch.where(width > SPREAD, WIDEST, width).clamp(SMALLEST, WIDEST)
