r"""Fits a `Mixture` to a function that is large on a small set, which uniform states meet never or by chance.

Adaptive importance sampling (Cappé et al., 2008): states are drawn from the last mixture and weighted by the function over
its density; expectation maximisation fits the next mixture to them. The effective part of the states (`effective_part`)
measures how well they suit a function.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.maths.mixtures import WIDEST, Mixture, effective_part
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator
from ocp_torch.maths.supremum import batched, supremum

SCANNED = 2**16  # uniform states, evaluated first: a feature smaller than one part in so many may be missed
ASCENTS = 16  # from the largest values of the scan
ASCENT_STEPS = 80
# An ascent that exceeds the largest scanned value by this factor shows a feature that the scan missed.
MISSED_FACTOR = 4.0
# Standard deviations of the components with which the fit then begins around it.
START_WIDTHS = tuple(0.1 * 10.0 ** (-0.5 * k) for k in range(9))
BROAD_PART = 0.5  # effective part of uniform states from which on no other states are worth more than twice as many
ROUND_STATES = 4096  # of each round of the fit
MOST_ROUNDS = 16
SUFFICIENT_PART = 0.4  # effective part of the states at which a round is the last
LEAST_PART = 0.1  # effective part that the next power of the function leaves: with less a few states decide the fit
BISECTIONS = 40  # for that power, whose interval is then 1e-12 wide
TAIL_PART = 0.25  # of each component, made wider for functions with heavier tails than a normal density
TAIL_WIDTH = 2.5  # by how much
MOST_COMPONENTS = 12  # which begin around states drawn by weight
EM_STEPS = 12
MOST_STATES = 2**13  # of a fit, the heaviest
NEGLIGIBLE_WEIGHT = 1e-12  # relative to the largest
LARGEST_FIRST_SHARE = 0.95  # of a component, before all are scaled to FITTED_PART
LEAST_SHARE = 1e-4  # below which a component is dropped
FITTED_PART = 0.9  # of the whole that is in components; the rest stays uniform, for what the states have missed
WIDEST_FITTED = 0.22  # a larger standard deviation is taken for uniform, whose own is 0.289
NARROWEST = 1e-9  # least standard deviation


@torch.no_grad()
def fitted_mixture(
    function: Callable[[Tensor], Tensor], dim: int, scanned: int = SCANNED, broad: float = BROAD_PART
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
    missed = top.value > float(level.max()) + math.log(MISSED_FACTOR)
    if effective_part((level - level.max()).exp()) >= broad and not missed:
        return Mixture.uniform(dim)
    density = torch.ones_like(level)
    mixture, power = Mixture.uniform(dim), 0.0
    for k in range(MOST_ROUNDS):
        if k == 0 and missed:
            mixture = _around(top.x)
        elif k:
            power, weights = _tempered(level, density, power)
            if power == 1.0 and effective_part(weights) >= SUFFICIENT_PART:
                break
            mixture = fitted_to(x, weights, density)
        if k or missed:
            points, weight = mixture.draw(ROUND_STATES, k, derive_seed(0, Branch.MIXTURE_FIT))
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

    least = min(LEAST_PART, 0.5 * effective_part(weights(power)))
    if effective_part(weights(1.0)) >= least:
        return 1.0, weights(1.0)
    low, high = power, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_part(weights(middle)) >= least else (low, middle)
    return low, weights(low)


def _around(centre: Tensor) -> Mixture:
    """Components of all `START_WIDTHS` around one state."""
    shares = torch.full((len(START_WIDTHS),), FITTED_PART / len(START_WIDTHS), dtype=centre.dtype)
    widths = torch.tensor(START_WIDTHS, dtype=centre.dtype).unsqueeze(-1).expand(-1, len(centre))
    return Mixture(shares, centre.expand(len(START_WIDTHS), -1), widths)


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
    used = weights.topk(min(MOST_STATES, len(weights))).indices
    used = used[weights[used] > NEGLIGIBLE_WEIGHT * weights.max()]
    x, weights, spacing = x[used], weights[used] / weights[used].sum(), spacing[used]
    generator = fixed_generator()
    start = torch.multinomial(weights, MOST_COMPONENTS, replacement=True, generator=generator)
    centres = x[start].unique(dim=0)
    away = _displacement(x, centres)
    nearest = away.square().sum(dim=-1).argmin(dim=1)
    own = away[torch.arange(len(x)), nearest].square()
    widths = torch.stack([_width(weights * (nearest == k), own, spacing) for k in range(len(centres))])
    shares = torch.stack([(weights * (nearest == k)).sum() for k in range(len(centres))]).clamp_max(LARGEST_FIRST_SHARE)
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
    """The shortest way on the torus from each centre to each state, ``(N, K, d)``."""
    away = x.unsqueeze(1) - centres
    return away - away.round()


def _width(weights: Tensor, squares: Tensor, spacing: Tensor) -> Tensor:
    """Standard deviations ``(d,)`` of weighted states, with that of a kernel as wide as half their ``spacing``."""
    total = weights.sum().clamp_min(1e-300)
    variance = (weights.unsqueeze(-1) * squares).sum(dim=0) / total
    own = (weights * spacing).sum() / total
    width = (variance + (0.5 * own / max(1.0, len(weights) * effective_part(weights)) ** 0.5) ** 2).sqrt()
    return torch.where(width > WIDEST_FITTED, WIDEST, width).clamp(NARROWEST, WIDEST)
