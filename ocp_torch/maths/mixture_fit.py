r"""Fits a `Mixture` to a function that is large on a small set, which uniform states meet never or by chance.

Adaptive importance sampling (Cappé et al., 2008): states are drawn from the last mixture and weighted by the function over
its density; expectation maximisation fits the next mixture to them. How well states suit a function is told by the
effective part of them.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.maths.mixtures import WIDEST, Mixture, effective_part
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator
from ocp_torch.maths.supremum import batched, supremum

# Uniform states at which the function is evaluated first. A feature smaller than one part in so many may be missed.
SCANNED = 2**16
# Ascents from the largest of these, and steps of each. A supremum that exceeds the largest scanned value by this factor shows
# a feature that the scan missed; the fit then begins around it, with all of these standard deviations at once.
ASCENTS, ASCENT_STEPS, MISSED = 16, 80, 4.0
SCALES = tuple(0.1 * 10.0 ** (-0.5 * k) for k in range(9))
# Where uniform states are this effective at least, no other states could be worth more than twice as many.
BROAD = 0.5
# States of each round of the fit, rounds at most, and the effective part of the states at which a round is the last.
ROUND, ROUNDS, SUFFICIENT = 4096, 16, 0.4
# The least effective part that the next power of the function may leave: less, and a few states decide the fit.
KEPT = 0.1
# Bisections for that power, whose interval is then 1e-12 wide.
BISECTIONS = 40
# Part of each component that is drawn so many times wider, for functions with heavier tails than a normal density.
TAIL_PART, TAIL_WIDTH = 0.25, 2.5
# Components at most, which begin around states drawn by weight, and steps.
COMPONENTS, EM_STEPS = 12, 12
# States that a fit uses at most, the heaviest, and the weight relative to the largest below which a state does not matter.
MOST, NEGLIGIBLE = 2**13, 1e-12
# The largest share a component begins with, before all are scaled to FITTED_PART; the share below which one is dropped.
LARGEST_START, LEAST_SHARE = 0.95, 1e-4
# Part of the whole that is in components; the rest stays uniform, for what the states have missed.
FITTED_PART = 0.9
# A fitted standard deviation above this is taken for uniform, whose own is 0.289; none is below the smallest.
SPREAD, SMALLEST = 0.22, 1e-9


@torch.no_grad()
def fitted_mixture(
    function: Callable[[Tensor], Tensor], dim: int, scanned: int = SCANNED, broad: float = BROAD
) -> Mixture:
    """A density to integrate ``function >= 0`` ``(N, d) -> (N,)`` by; uniform where the effective part of uniform states is
    ``broad`` at least.

    The function is evaluated at ``scanned`` Sobol points and on ascents from the highest. Mixtures are then fitted in turn to
    powers of it (tempering), which rise to 1 as fast as the states of the last mixture allow.
    """
    log = lambda x: batched(function, x).clamp_min(0.0).log()
    x = scrambled_sobol(scanned, dim, 1, torch.float64)
    level = log(x)
    top = supremum(log, x[level.topk(min(4 * ASCENTS, len(x))).indices], ASCENTS, ASCENT_STEPS, differentiable=False)
    if not math.isfinite(top.value):
        return Mixture.uniform(dim)
    missed = top.value > float(level.max()) + math.log(MISSED)
    if effective_part((level - level.max()).exp()) >= broad and not missed:
        return Mixture.uniform(dim)
    density = torch.ones_like(level)
    mixture, power = Mixture.uniform(dim), 0.0
    for k in range(ROUNDS):
        if k == 0 and missed:
            mixture = _around(top.x)
        elif k:
            power, weights = _tempered(level, density, power)
            if power == 1.0 and effective_part(weights) >= SUFFICIENT:
                break
            mixture = fitted_to(x, weights, density)
        if k or missed:
            points, weight = mixture.draw(ROUND, k, derive_seed(0, Branch.MIXTURE_FIT))
            x, density, level = points, 1.0 / weight, log(points)
    return _with_tails(mixture)


def concentrated(x: Tensor, values: Tensor, density: Tensor) -> Mixture:
    """Components fitted to states ``(N, d)`` of a known ``density``, each with a part of the whole in proportion to
    ``values`` ``(N,)``."""
    return _with_tails(fitted_to(x, values / values.max().clamp_min(1e-300), density))


def _tempered(level: Tensor, density: Tensor, power: float) -> tuple[float, Tensor]:
    """The next power of the function, whose logarithm is ``level``, and the weights of its states for it."""

    def weights(p: float) -> Tensor:
        exponent = torch.where(torch.isfinite(level), p * level, -math.inf) - density.log()
        return (exponent - exponent.max()).exp()

    least = min(KEPT, 0.5 * effective_part(weights(power)))
    if effective_part(weights(1.0)) >= least:
        return 1.0, weights(1.0)
    low, high = power, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_part(weights(middle)) >= least else (low, middle)
    return low, weights(low)


def _around(centre: Tensor) -> Mixture:
    """All scales around one state."""
    shares = torch.full((len(SCALES),), FITTED_PART / len(SCALES), dtype=centre.dtype)
    widths = torch.tensor(SCALES, dtype=centre.dtype).unsqueeze(-1).expand(-1, len(centre))
    return Mixture(shares, centre.expand(len(SCALES), -1), widths)


def _with_tails(mixture: Mixture) -> Mixture:
    if mixture.is_uniform:
        return mixture
    wide = Mixture(TAIL_PART * mixture.shares, mixture.centres, (TAIL_WIDTH * mixture.widths).clamp_max(WIDEST))
    return Mixture.join([Mixture((1.0 - TAIL_PART) * mixture.shares, mixture.centres, mixture.widths), wide])


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
    for _ in range(EM_STEPS):
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
