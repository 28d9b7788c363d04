r"""Taylor models: polynomials over a batch of cells with a radius that bounds everything they leave out.

A cell is `x = c + h t` with `t` in `[-1, 1]^d`. A model of `g` holds coefficients `p_alpha` and a radius `r` with
`|g(c + h t) - sum_alpha p_alpha t^alpha| <= r` for every `t` of the cell (Makino and Berz, *Taylor models and other
validated functional inclusion methods*, 2003). Sums and products keep that true in floating point: each adds to the
radius what its rounding can change.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from ocp_torch.maths.sums import summed

# Rounding of one operation on models, relative to the sum of the absolute values of what it adds up: an operation does
# fewer than 256 roundings of 2^-53 on any path, and gamma_256 < 2^-44 (Higham, Accuracy and Stability of Numerical
# Algorithms, section 3.1). Library functions are assumed to be accurate to 16 units in the last place.
ROUNDING = 2.0**-44
# A radius is a short sum of products of numbers >= 0: this factor covers the rounding of that sum itself.
UPWARD = 1.0 + 2.0**-40
SMALLEST = 1e-290  # added to a radius to cover underflow


def upward(radius: Tensor) -> Tensor:
    """``radius``, a sum of products of numbers >= 0, with room for the rounding of its own computation."""
    return radius * UPWARD + SMALLEST


class Monomials:
    """The exponents `alpha` of the monomials in ``dim`` variables with `|alpha| <= degree`, sorted by degree.

    ``products`` lists `(i, j, k)`: monomial `i` times monomial `j` is monomial `k`, where its degree is not too high.
    Polynomials are their coefficients ``(K, N, ...)`` in this order, over `N` cells.
    """

    def __init__(self, dim: int, degree: int) -> None:
        self.dim, self.degree = dim, degree
        every = itertools.product(range(degree + 1), repeat=dim)
        self.exponents = sorted((a for a in every if sum(a) <= degree), key=lambda a: (sum(a), a))
        self.index = {alpha: k for k, alpha in enumerate(self.exponents)}
        # Monomials of degree j stand at ends[j] ... ends[j + 1] - 1.
        self.ends = [sum(sum(a) < j for a in self.exponents) for j in range(degree + 2)]
        self.products = [
            (i, j, self.index[tuple(p + q for p, q in zip(a, b, strict=True))])
            for i, a in enumerate(self.exponents)
            for j, b in enumerate(self.exponents)
            if sum(a) + sum(b) <= degree
        ]

    def sizes(self, coefficients: Tensor) -> list[Tensor]:
        """Sum of the absolute coefficients of each degree, ``(N, ...)``."""
        return [coefficients[a:b].abs().sum(dim=0) for a, b in itertools.pairwise(self.ends)]

    def product(self, left: Tensor, right: Tensor) -> Tensor:
        """The coefficients of the product of two polynomials, without what is of too high a degree."""
        result = left.new_zeros(len(left), *torch.broadcast_shapes(left.shape[1:], right.shape[1:]))
        for i, j, k in self.products:
            result[k].addcmul_(left[i], right[j])
        return result

    def left_out(self, left: list[Tensor], right: list[Tensor]) -> Tensor:
        """The size of what `product` leaves out, from the `sizes` of its factors."""
        degree = self.degree
        return summed(left[i] * right[j] for i in range(1, degree + 1) for j in range(degree + 1 - i, degree + 1))


monomials = cache(Monomials)


@dataclass(frozen=True)
class TaylorModel:
    """``coefficients`` ``(K, N, ...)`` by the order of ``basis``, and ``radius`` ``(N, ...)``, over `N` cells."""

    coefficients: Tensor
    radius: Tensor
    basis: Monomials

    @classmethod
    def constant(cls, value: Tensor, radius: Tensor, basis: Monomials) -> "TaylorModel":
        """A model that only knows ``value`` ``(N, ...)`` up to ``radius``."""
        rest = value.new_zeros(len(basis.exponents) - 1, *value.shape)
        return cls(torch.cat([value.unsqueeze(0), rest]), radius.expand(value.shape), basis)

    @classmethod
    def stack(cls, models: Sequence["TaylorModel"]) -> "TaylorModel":
        """Scalar models side by side, as the last axis."""
        coefficients = torch.stack([m.coefficients for m in models], dim=-1)
        return cls(coefficients, torch.stack([m.radius for m in models], dim=-1), models[0].basis)

    @property
    def size(self) -> Tensor:
        """Sum of the absolute coefficients: a bound of the polynomial."""
        return self.coefficients.abs().sum(dim=0)

    def _with(self, coefficients: Tensor, radius: Tensor, magnitude: Tensor) -> "TaylorModel":
        return TaylorModel(coefficients, upward(radius + ROUNDING * magnitude), self.basis)

    def __getitem__(self, index) -> "TaylorModel":
        """Entries of the axes after the cells."""
        own = (slice(None), *index) if isinstance(index, tuple) else (slice(None), index)
        return TaylorModel(self.coefficients[(slice(None),) + own], self.radius[own], self.basis)

    def __neg__(self) -> "TaylorModel":
        return TaylorModel(-self.coefficients, self.radius, self.basis)

    def __add__(self, other: "TaylorModel | Tensor | float") -> "TaylorModel":
        if not isinstance(other, TaylorModel):
            total = self.coefficients.clone()
            total[0] += other
            return self._with(total, self.radius, total[0].abs())
        total = self.coefficients + other.coefficients
        return self._with(total, self.radius + other.radius, total.abs().sum(dim=0))

    def __sub__(self, other: "TaylorModel | Tensor | float") -> "TaylorModel":
        return self + (-other)

    def __mul__(self, other: "TaylorModel | Tensor | float") -> "TaylorModel":
        if not isinstance(other, TaylorModel):
            scaled = self.coefficients * other
            size = other.abs() if isinstance(other, Tensor) else abs(other)
            return self._with(scaled, self.radius * size, scaled.abs().sum(dim=0))
        left, right, basis = self.coefficients, other.coefficients, self.basis
        size, its_size = self.size, other.size
        cut = basis.left_out(basis.sizes(left), basis.sizes(right))
        radius = self.radius * (its_size + other.radius) + size * other.radius + cut
        return self._with(basis.product(left, right), radius, size * its_size)

    def __truediv__(self, other: float) -> "TaylorModel":
        return self * (1.0 / other)

    def reshape(self, *shape: int) -> "TaylorModel":
        """The axes after the cells in another shape."""
        K, N = self.coefficients.shape[:2]
        return TaylorModel(self.coefficients.reshape(K, N, *shape), self.radius.reshape(N, *shape), self.basis)

    def sum(self, dim: int = -1) -> "TaylorModel":
        """Sum over an axis counted from the end."""
        total = self.coefficients.sum(dim=dim)
        return self._with(total, self.radius.sum(dim=dim), self.coefficients.abs().sum(dim=dim).sum(dim=0))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds over each cell; a monomial of even exponents lies in `[0, 1]`, any other in `[-1, 1]`."""
        even = torch.tensor([all(e % 2 == 0 for e in a) for a in self.basis.exponents])
        even[0] = False
        half, rest = self.coefficients[even], self.coefficients[~even]
        room = upward(self.radius + rest[1:].abs().sum(dim=0) + ROUNDING * self.size)
        centre = rest[0]
        return centre + half.clamp_max(0.0).sum(dim=0) - room, centre + half.clamp_min(0.0).sum(dim=0) + room

    def mean(self) -> tuple[Tensor, Tensor]:
        """Mean over each cell: value and radius."""
        means = [math.prod(0.0 if e % 2 else 1.0 / (e + 1) for e in a) for a in self.basis.exponents]
        value = torch.tensordot(self.coefficients.new_tensor(means), self.coefficients, dims=1)
        return value, upward(self.radius + ROUNDING * self.size)

    def where(self, condition: Tensor, other: "TaylorModel") -> "TaylorModel":
        """This model in the cells where ``condition`` holds, ``other`` elsewhere."""
        coefficients = torch.where(condition, self.coefficients, other.coefficients)
        return TaylorModel(coefficients, torch.where(condition, self.radius, other.radius), self.basis)
