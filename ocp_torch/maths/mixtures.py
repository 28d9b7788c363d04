r"""A density on the torus, part uniform and part normal components wrapped around it, to draw states from.

Its points are randomised quasi-Monte Carlo points, each with one over the density as its weight: weighted means over them
estimate integrals over the torus without bias whatever the density (defensive mixtures: Owen and Zhou, 2000).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.maths.sampling import evaluation_points
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import batched

WIDEST = 0.5  # standard deviation at which a wrapped normal density is as good as uniform, to 1.4 % at most
IMAGES = 3  # copies of a wrapped density on each side of the torus: at WIDEST the next is 7 standard deviations away
NARROW = 0.06  # standard deviation below which only the nearest copy counts: the others are 8 of it away
CHUNK = 2**13  # states whose density is computed at once: all components of them fit the cache


@dataclass(frozen=True)
class Mixture:
    """Normal components, wrapped around the torus, with ``shares`` ``(K,)`` of the whole; the rest is uniform."""

    shares: Tensor
    centres: Tensor  # (K, d)
    widths: Tensor  # (K, d) standard deviations

    @classmethod
    def uniform(cls, dim: int) -> "Mixture":
        none = torch.zeros(0, dim, dtype=torch.float64)
        return cls(none[:, 0], none, none)

    @property
    def dim(self) -> int:
        return self.centres.shape[1]

    @property
    def is_uniform(self) -> bool:
        return len(self.shares) == 0

    def scaled(self, part: float) -> "Mixture":
        """The mixture with ``part`` of the whole in the components, and the rest uniform."""
        return self if self.is_uniform else Mixture(part * self.shares / self.shares.sum(), self.centres, self.widths)

    @staticmethod
    def join(mixtures: "list[Mixture]") -> "Mixture":
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
            # The nearest copy is in the exponent; the ratio of all copies to it multiplies the density.
            for wide in (width > NARROW).nonzero().squeeze(-1).tolist():
                near, size = away[:, wide], width[wide]
                others[:, wide] *= sum(
                    (0.5 * (near.square() - (near + i).square()) / size.square()).exp()
                    for i in range(-IMAGES, IMAGES + 1)
                )
        return others * exponent.exp() / (math.sqrt(2.0 * math.pi) * self.widths).prod(dim=1)

    def density(self, x: Tensor) -> Tensor:
        """The whole density ``(N,)``, strictly positive."""
        return batched(lambda part: 1.0 - self.shares.sum() + self.components(part) @ self.shares, x, CHUNK)

    def draw(self, count: int, replicate: int, seed: int, extra: int = 0) -> tuple[Tensor, Tensor]:
        """``count`` points ``(count, d + extra)``, ``extra`` coordinates uniform, and one over their density ``(count,)``.

        Each component has a point set of its own, whose size is its share of ``count`` rounded up or down by chance. The
        uniform density has `evaluation_points`; others have points in random order, of which any part may be used.
        """
        if self.is_uniform:
            points = evaluation_points(count, self.dim + extra, replicate, seed)
            return points, torch.ones_like(points[:, 0])
        generator = torch.Generator().manual_seed(derive_seed(seed, Branch.MIXTURE_SIZES, replicate))
        # One random shift of all ends rounds every share up or down, and on average to what it is.
        ends = (self.shares.cumsum(0) * count + torch.rand((), generator=generator)).floor().clamp_max(count).long()
        sizes = ends.diff(prepend=torch.zeros(1, dtype=torch.long))
        rest = count - int(ends[-1])
        pieces = [evaluation_points(rest, self.dim + extra, replicate, seed)] if rest else []
        for k in sizes.nonzero().squeeze(-1).tolist():
            points = evaluation_points(
                int(sizes[k]), self.dim + extra, replicate, derive_seed(seed, Branch.MIXTURE_POINTS, k)
            )
            # The quantile function takes uniform points to normal ones; at 0 and 1 it is infinite.
            normal = torch.special.ndtri(points[:, : self.dim].clamp(2.0**-53, 1.0 - 2.0**-53))
            points[:, : self.dim] = (self.centres[k] + self.widths[k] * normal).remainder(1.0)
            pieces.append(points)
        points = torch.cat(pieces)[torch.randperm(count, generator=generator)]
        return points, 1.0 / self.density(points[:, : self.dim])


def effective_part(weights: Tensor) -> float:
    """The effective sample size of ``weights >= 0`` ``(N,)``, `(sum w)^2 / sum w^2` (Kish), over `N`; 0 where all are 0."""
    total = float(weights.sum())
    return total**2 / (len(weights) * float(weights.square().sum())) if total > 0.0 and math.isfinite(total) else 0.0
