"""A periodic grid on the unit torus: nodes, interpolation stencils and differences."""

from dataclasses import dataclass

import torch
from torch import Tensor

OFFSETS = 4  # nodes of the cubic stencil per coordinate


@dataclass(frozen=True)
class Stencil:
    """Nodes around ``N`` points, and their multilinear (zero outside the cell) and cubic weights; each ``(N, 4^d)``."""

    index: Tensor
    linear: Tensor
    cubic: Tensor


class Grid:
    """``side`` nodes per coordinate of the `dim`-dimensional unit torus, at multiples of `h = 1 / side`; float64."""

    def __init__(self, dim: int, side: int) -> None:
        self.dim, self.side = dim, side
        self.count, self.spacing = side**dim, 1.0 / side
        self._strides = [side ** (dim - 1 - k) for k in range(dim)]

    def nodes(self) -> Tensor:
        """All nodes, ``(side^d, d)``, the last coordinate running fastest."""
        line = torch.arange(self.side, dtype=torch.float64) / self.side
        return torch.cartesian_prod(*[line] * self.dim).reshape(-1, self.dim)

    def stencil(self, x: Tensor) -> Stencil:
        """The stencils at points ``(N, d)``, any reals."""
        position = x * self.side
        base = position.floor()
        t = (position - base).unsqueeze(-1)
        s, r, p = t - 1.0, t - 2.0, t + 1.0
        cubic = torch.cat([-t * s * r / 6.0, p * s * r / 2.0, -p * t * r / 2.0, p * t * s / 6.0], dim=-1)
        zero = torch.zeros_like(t)
        linear = torch.cat([zero, -s, t, zero], dim=-1)
        near = torch.arange(-1, OFFSETS - 1)
        index = (base.long().unsqueeze(-1) + near).remainder(self.side)
        flat, low, high = index[:, 0] * self._strides[0], linear[:, 0], cubic[:, 0]
        outer = lambda left, right: (left.unsqueeze(-1) * right.unsqueeze(-2)).flatten(1)
        for k in range(1, self.dim):
            flat = (flat.unsqueeze(-1) + (index[:, k] * self._strides[k]).unsqueeze(-2)).flatten(1)
            low, high = outer(low, linear[:, k]), outer(high, cubic[:, k])
        return Stencil(flat, low, high)

    def interpolated(self, field: Tensor, x: Tensor) -> Tensor:
        """A vector field ``(side^d, k)``, multilinearly between the nodes, at points ``(N, d)``; ``(N, k)``."""
        stencil = self.stencil(x)
        return (stencil.linear.unsqueeze(-1) * field[stencil.index]).sum(dim=1)

    def shifted(self, field: Tensor, coordinate: int, cells: int) -> Tensor:
        """At each node the value of ``field`` ``(side^d, ...)`` that many ``cells`` further along ``coordinate``."""
        shape = [self.side] * self.dim
        return field.reshape(*shape, *field.shape[1:]).roll(-cells, dims=coordinate).reshape(field.shape)

    def gradient(self, values: Tensor) -> Tensor:
        """Central differences of fourth order, ``(side^d, d)``."""
        across = lambda k, cells: self.shifted(values, k, cells) - self.shifted(values, k, -cells)
        slope = lambda k: (8.0 * across(k, 1) - across(k, 2)) / (12.0 * self.spacing)
        return torch.stack([slope(k) for k in range(self.dim)], dim=-1)
