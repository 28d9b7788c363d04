r"""Where to look: a density on the torus, part uniform and part wrapped normal, fitted to a function that is large on a small
set, and randomised quasi-Monte Carlo points of that density, with one over it as their weight.

Whatever the density, weighted means over its points estimate integrals over the torus without bias; a good one makes the
error small where uniform states meet the set never or by chance (Owen and Zhou, 2000; Cappé et al., 2008).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.maths.sampling import evaluation_points, scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator
from ocp_torch.maths.supremum import batched, supremum

# Images of a normal density on each side, from a width where the nearest is not all, to one as good as uniform.
IMAGES, WRAPPED, WIDEST = 3, 0.06, 0.5
# A fitted standard deviation above this (that of the uniform law is 0.289) stands for uniform.
SPREAD = 0.22
# States the function is looked at, ascents from the highest of them, and states of each round of fitting.
SCANNED, ASCENTS, ASCENT_STEPS, ROUND = 2**16, 16, 80, 4096
# A function whose uniform states are worth at least that part of their number needs no other states.
BROAD = 0.5
# A supremum climbed to that many times above the largest scanned value shows a feature that the scan missed.
MISSED = 4.0
# Components fitted, rounds at most, steps of expectation maximisation, and the worth at which a round is the last.
COMPONENTS, ROUNDS, STEPS, WORTH = 12, 16, 12, 0.4
# Worth each tempered round keeps; standard deviations around a climbed maximum to begin with.
KEPT, SCALES = 0.1, tuple(0.1 * 10.0 ** (-0.5 * k) for k in range(9))
# The heaviest states are fitted to, at most so many.
MOST = 2**13
# Part of each component that is drawn so many times wider, for tails that are no normal law's.
TAIL_PART, TAIL_WIDTH = 0.25, 2.5


@dataclass(frozen=True)
class Mixture:
    """Normal components, wrapped around the torus, with ``shares`` ``(K,)`` of the whole; the rest is uniform."""

    shares: Tensor
    centres: Tensor  # (K, d)
    widths: Tensor  # (K, d) standard deviations

    @classmethod
    def uniform(cls, dim: int) -> Mixture:
        none = torch.zeros(0, dim, dtype=torch.float64)
        return cls(none[:, 0], none, none)

    @property
    def dim(self) -> int:
        return self.centres.shape[1]

    @property
    def is_uniform(self) -> bool:
        return len(self.shares) == 0

    def scaled(self, part: float) -> Mixture:
        """With ``part`` of the whole in the components, and the rest uniform."""
        return self if self.is_uniform else Mixture(part * self.shares / self.shares.sum(), self.centres, self.widths)

    @staticmethod
    def join(mixtures: list[Mixture]) -> Mixture:
        """The components of all, with the shares they have."""
        return Mixture(*(torch.cat([getattr(m, k) for m in mixtures]) for k in ("shares", "centres", "widths")))

    def components(self, x: Tensor) -> Tensor:
        """The density of each component at states ``(N, d)``, ``(N, K)``."""
        exponent = x.new_zeros(len(x), len(self.shares))
        others = x.new_ones(len(x), len(self.shares))
        for k in range(self.dim):
            away = x[:, k, None] - self.centres[:, k]
            away, width = away - away.round(), self.widths[:, k]
            exponent = exponent - 0.5 * (away / width).square()
            for wide in (width > WRAPPED).nonzero().squeeze(-1).tolist():
                near, size = away[:, wide], width[wide]
                others[:, wide] *= sum(
                    (0.5 * (near.square() - (near + i).square()) / size.square()).exp()
                    for i in range(-IMAGES, IMAGES + 1)
                )
        return others * exponent.exp() / (math.sqrt(2.0 * math.pi) * self.widths).prod(dim=1)

    def density(self, x: Tensor) -> Tensor:
        """The whole density ``(N,)``, strictly positive."""
        return batched(lambda part: 1.0 - self.shares.sum() + self.components(part) @ self.shares, x, 2**13)

    def draw(self, count: int, replicate: int, seed: int, extra: int = 0) -> tuple[Tensor, Tensor]:
        """``count`` points ``(count, d + extra)``, ``extra`` coordinates uniform, and one over their density ``(count,)``.

        Each component has a point set of its own, whose size is its share of ``count`` rounded up or down by chance. Uniform,
        these are `evaluation_points`; else their order is random, and a part of them will do.
        """
        if self.is_uniform:
            points = evaluation_points(count, self.dim + extra, replicate, seed)
            return points, torch.ones_like(points[:, 0])
        generator = torch.Generator().manual_seed(derive_seed(seed, Branch.MIXTURE_SIZES, replicate))
        ends = (self.shares.cumsum(0) * count + torch.rand((), generator=generator)).floor().clamp_max(count).long()
        sizes = ends.diff(prepend=torch.zeros(1, dtype=torch.long))
        rest = count - int(ends[-1])
        pieces = [evaluation_points(rest, self.dim + extra, replicate, seed)] if rest else []
        for k in sizes.nonzero().squeeze(-1).tolist():
            points = evaluation_points(
                int(sizes[k]), self.dim + extra, replicate, derive_seed(seed, Branch.MIXTURE_POINTS, k)
            )
            normal = torch.special.ndtri(points[:, : self.dim].clamp(2.0**-53, 1.0 - 2.0**-53))
            points[:, : self.dim] = (self.centres[k] + self.widths[k] * normal).remainder(1.0)
            pieces.append(points)
        points = torch.cat(pieces)[torch.randperm(count, generator=generator)]
        return points, 1.0 / self.density(points[:, : self.dim])


def worth(weights: Tensor) -> float:
    """How many equal weights ``weights >= 0`` are worth, as a part of their number (Kish): 0 where all are 0."""
    total = float(weights.sum())
    return total**2 / (len(weights) * float(weights.square().sum())) if total > 0.0 and math.isfinite(total) else 0.0


@torch.no_grad()
def fitted_mixture(
    function: Callable[[Tensor], Tensor], dim: int, scanned: int = SCANNED, broad: float = BROAD
) -> Mixture:
    """A density to integrate ``function >= 0`` ``(N, d) -> (N,)`` by; uniform where uniform states are worth ``broad``.

    It is looked at ``scanned`` Sobol points and on ascents from the highest. Tempered: densities are fitted in turn to powers
    of the function that rise to 1 as fast as the last one's states allow.
    """
    log = lambda x: batched(function, x).clamp_min(0.0).log()
    x = scrambled_sobol(scanned, dim, 1, torch.float64)
    level = log(x)
    top = supremum(log, x[level.topk(min(4 * ASCENTS, len(x))).indices], ASCENTS, ASCENT_STEPS, differentiable=False)
    if not math.isfinite(top.value):
        return Mixture.uniform(dim)
    missed = top.value > float(level.max()) + math.log(MISSED)
    if worth((level - level.max()).exp()) >= broad and not missed:
        return Mixture.uniform(dim)
    density = torch.ones_like(level)
    mixture, power = Mixture.uniform(dim), 0.0
    for k in range(ROUNDS):
        if k == 0 and missed:
            mixture = _around(top.x)
        elif k:
            power, weights = _tempered(level, density, power)
            if power == 1.0 and worth(weights) >= WORTH:
                break
            mixture = _maximised(x, weights, density)
        if k or missed:
            points, weight = mixture.draw(ROUND, k, derive_seed(0, Branch.MIXTURE_FIT))
            x, density, level = points, 1.0 / weight, log(points)
    return _with_tails(mixture)


def concentrated(x: Tensor, values: Tensor, density: Tensor) -> Mixture:
    """Components fitted to states ``(N, d)`` of a known ``density``, each with a part of the whole in proportion to
    ``values`` ``(N,)``."""
    return _with_tails(_maximised(x, values / values.max().clamp_min(1e-300), density))


def _tempered(level: Tensor, density: Tensor, power: float) -> tuple[float, Tensor]:
    """The next power of the function, whose logarithm is ``level``, and the weights of its states for it."""

    def weights(p: float) -> Tensor:
        exponent = torch.where(torch.isfinite(level), p * level, -math.inf) - density.log()
        return (exponent - exponent.max()).exp()

    least = min(KEPT, 0.5 * worth(weights(power)))
    if worth(weights(1.0)) >= least:
        return 1.0, weights(1.0)
    low, high = power, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if worth(weights(middle)) >= least else (low, middle)
    return low, weights(low)


def _around(centre: Tensor) -> Mixture:
    """All scales around one state."""
    shares = torch.full((len(SCALES),), 0.9 / len(SCALES), dtype=centre.dtype)
    widths = torch.tensor(SCALES, dtype=centre.dtype).unsqueeze(-1).expand(-1, len(centre))
    return Mixture(shares, centre.expand(len(SCALES), -1), widths)


def _maximised(x: Tensor, weights: Tensor, density: Tensor) -> Mixture:
    """Components and uniform part fitted to weighted states by expectation maximisation. ``density`` says how far apart the
    states are, which no component is narrower than."""
    dim = x.shape[1]
    spacing = (len(x) * density) ** (-1.0 / dim)
    used = weights.topk(min(MOST, len(weights))).indices
    used = used[weights[used] > 1e-12 * weights.max()]
    x, weights, spacing = x[used], weights[used] / weights[used].sum(), spacing[used]
    generator = fixed_generator()
    start = torch.multinomial(weights, COMPONENTS, replacement=True, generator=generator)
    centres = x[start].unique(dim=0)
    away = _displacement(x, centres)
    nearest = away.square().sum(dim=-1).argmin(dim=1)
    own = away[torch.arange(len(x)), nearest].square()
    widths = torch.stack([_width(weights * (nearest == k), own, spacing) for k in range(len(centres))])
    shares = torch.stack([(weights * (nearest == k)).sum() for k in range(len(centres))]).clamp_max(0.95)
    mixture = Mixture(0.9 * shares / shares.sum(), centres, widths)
    for _ in range(STEPS):
        parts = mixture.components(x) * mixture.shares
        parts = parts / (parts.sum(dim=1, keepdim=True) + 1.0 - mixture.shares.sum()) * weights.unsqueeze(-1)
        shares = parts.sum(dim=0)
        alive = shares > 1e-4
        if not alive.any():
            return Mixture.uniform(dim)
        parts, shares, centres = parts[:, alive], shares[alive], mixture.centres[alive]
        away = _displacement(x, centres)
        move = (parts.unsqueeze(-1) * away).sum(dim=0) / shares.unsqueeze(-1)
        spread = (away - move).square()
        widths = torch.stack([_width(parts[:, k], spread[:, k], spacing) for k in range(len(shares))])
        # A tenth stays uniform: what the states so far have missed.
        mixture = Mixture(shares * min(1.0, 0.9 / float(shares.sum())), (centres + move).remainder(1.0), widths)
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
    width = (variance + (0.5 * own / max(1.0, len(weights) * worth(weights)) ** 0.5) ** 2).sqrt()
    return torch.where(width > SPREAD, WIDEST, width).clamp(1e-9, WIDEST)


def _with_tails(mixture: Mixture) -> Mixture:
    if mixture.is_uniform:
        return mixture
    wide = Mixture(TAIL_PART * mixture.shares, mixture.centres, (TAIL_WIDTH * mixture.widths).clamp_max(WIDEST))
    return Mixture.join([Mixture((1.0 - TAIL_PART) * mixture.shares, mixture.centres, mixture.widths), wide])
