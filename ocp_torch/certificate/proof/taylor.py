r"""Taylor models: polynomials over a batch of cells with a radius that bounds everything they leave out.

A cell is `x = c + h t` with `t` in `[-1, 1]^d`. A model of `g` holds coefficients `p_alpha` and a radius `r` with
`|g(c + h t) - sum_alpha p_alpha t^alpha| <= r` for every `t` of the cell (Makino and Berz, *Taylor models and other
validated functional inclusion methods*, 2003). Sums and products keep that true in floating point: each adds to the
radius what its rounding can change (`ocp_torch.certificate.proof.rounding`).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.proof.monomials import Monomials
from ocp_torch.certificate.proof.rounding import ROUNDING, upward


@dataclass(frozen=True)
class TaylorModel:
    """``coefficients`` ``(K, N, ...)`` by the order of ``basis``, and ``radius`` ``(N, ...)``, over `N` cells."""

    coefficients: Tensor
    radius: Tensor
    basis: Monomials

    @classmethod
    def constant(cls, value: Tensor, radius: Tensor, basis: Monomials) -> TaylorModel:
        """A model that only knows ``value`` ``(N, ...)`` up to ``radius``."""
        rest = value.new_zeros(basis.count - 1, *value.shape)
        return cls(torch.cat([value.unsqueeze(0), rest]), radius.expand(value.shape), basis)

    @classmethod
    def stack(cls, models: Sequence[TaylorModel]) -> TaylorModel:
        """Scalar models side by side, as the last axis."""
        coefficients = torch.stack([m.coefficients for m in models], dim=-1)
        return cls(coefficients, torch.stack([m.radius for m in models], dim=-1), models[0].basis)

    @property
    def size(self) -> Tensor:
        """Sum of the absolute coefficients: a bound of the polynomial."""
        return self.coefficients.abs().sum(dim=0)

    def degree_sizes(self) -> list[Tensor]:
        """The same for the monomials of each degree."""
        ends = self.basis.ends
        return [self.coefficients[a:b].abs().sum(dim=0) for a, b in itertools.pairwise(ends)]

    def _with(self, coefficients: Tensor, radius: Tensor, magnitude: Tensor) -> TaylorModel:
        return TaylorModel(coefficients, upward(radius + ROUNDING * magnitude), self.basis)

    def __getitem__(self, index) -> TaylorModel:
        """Entries of the axes after the cells."""
        index = index if isinstance(index, tuple) else (index,)
        every = (slice(None),)
        return TaylorModel(self.coefficients[every + every + index], self.radius[every + index], self.basis)

    def __neg__(self) -> TaylorModel:
        return TaylorModel(-self.coefficients, self.radius, self.basis)

    def __add__(self, other: TaylorModel | Tensor | float) -> TaylorModel:
        if not isinstance(other, TaylorModel):
            total = self.coefficients.clone()
            total[0] += other
            return self._with(total, self.radius, total[0].abs())
        total = self.coefficients + other.coefficients
        return self._with(total, self.radius + other.radius, total.abs().sum(dim=0))

    def __sub__(self, other: TaylorModel | Tensor | float) -> TaylorModel:
        return self + (-other)

    def __mul__(self, other: TaylorModel | Tensor | float) -> TaylorModel:
        if not isinstance(other, TaylorModel):
            scaled = self.coefficients * other
            size = other.abs() if isinstance(other, Tensor) else abs(other)
            return self._with(scaled, self.radius * size, scaled.abs().sum(dim=0))
        left, right = self.coefficients, other.coefficients
        product = left.new_zeros(len(left), *torch.broadcast_shapes(left.shape[1:], right.shape[1:]))
        for i, j, k in self.basis.products:
            product[k].addcmul_(left[i], right[j])
        mine, its, degree = self.degree_sizes(), other.degree_sizes(), self.basis.degree
        cut = sum((mine[i] * its[j] for i in range(1, degree + 1) for j in range(degree + 1 - i, degree + 1)), 0.0)
        size, its_size = self.size, other.size
        radius = self.radius * (its_size + other.radius) + size * other.radius + cut
        return self._with(product, radius, size * its_size)

    def __truediv__(self, other: float) -> TaylorModel:
        return self * (1.0 / other)

    def reshape(self, *shape: int) -> TaylorModel:
        """The axes after the cells in another shape."""
        K, N = self.coefficients.shape[:2]
        return TaylorModel(self.coefficients.reshape(K, N, *shape), self.radius.reshape(N, *shape), self.basis)

    def sum(self, dim: int = -1) -> TaylorModel:
        """Sum over an axis counted from the end."""
        total = self.coefficients.sum(dim=dim)
        return self._with(total, self.radius.sum(dim=dim), self.coefficients.abs().sum(dim=dim).sum(dim=0))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds over each cell; an even monomial lies in `[0, 1]`, any other in `[-1, 1]`."""
        even = torch.tensor(self.basis.even, device=self.radius.device)
        even[0] = False
        half, rest = self.coefficients[even], self.coefficients[~even]
        spread = self.radius + rest[1:].abs().sum(dim=0)
        room = upward(spread + ROUNDING * self.size)
        centre = rest[0]
        return centre + half.clamp_max(0.0).sum(dim=0) - room, centre + half.clamp_min(0.0).sum(dim=0) + room

    def mean(self) -> tuple[Tensor, Tensor]:
        """Mean over each cell: value and radius."""
        weights = self.coefficients.new_tensor(self.basis.means)
        value = torch.tensordot(weights, self.coefficients, dims=1)
        return value, upward(self.radius + ROUNDING * self.size)

    def where(self, condition: Tensor, other: TaylorModel) -> TaylorModel:
        """This model in the cells where ``condition`` holds, ``other`` elsewhere."""
        coefficients = torch.where(condition, self.coefficients, other.coefficients)
        return TaylorModel(coefficients, torch.where(condition, self.radius, other.radius), self.basis)
