r"""Taylor models: polynomials over a batch of cells with a radius that bounds everything they leave out.

A cell is `x = c + h t` with `t` in `[-1, 1]^d`. A model of `g` holds coefficients `p_alpha` and a radius `r` with
`|g(c + h t) - sum_alpha p_alpha t^alpha| <= r` for every `t` of the cell. Sums, products and compositions keep that true
in floating point: each operation adds to the radius what its rounding can change, as stated at `ROUNDING`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

# Rounding of one operation here, relative to the sum of the absolute values of what it adds up: an operation does fewer
# than 256 roundings of 2^-53 on any path (`gamma_256 < 2^-44`, Higham), library functions included, which are assumed
# to be accurate to 16 units in the last place.
ROUNDING = 2.0**-44
# A radius is a short sum of products of numbers >= 0; this makes up for its own rounding, and the second for underflow.
UPWARD, SMALLEST = 1.0 + 2.0**-40, 1e-290


class Monomials:
    """The exponents `alpha` of ``dim`` variables with `|alpha| <= degree`, by degree; and what multiplies into what."""

    def __init__(self, dim: int, degree: int) -> None:
        self.dim, self.degree = dim, degree
        every = itertools.product(range(degree + 1), repeat=dim)
        self.exponents = sorted((a for a in every if sum(a) <= degree), key=lambda a: (sum(a), a))
        self.index = {alpha: k for k, alpha in enumerate(self.exponents)}
        self.count = len(self.exponents)
        # Monomials of degree j stand at ends[j] ... ends[j + 1] - 1.
        self.ends = [sum(sum(a) < j for a in self.exponents) for j in range(degree + 2)]
        self.products = [
            (i, j, self.index[tuple(p + q for p, q in zip(a, b, strict=True))])
            for i, a in enumerate(self.exponents)
            for j, b in enumerate(self.exponents)
            if sum(a) + sum(b) <= degree
        ]
        self.means = [math.prod(0.0 if e % 2 else 1.0 / (e + 1) for e in a) for a in self.exponents]
        self.even = [all(e % 2 == 0 for e in a) for a in self.exponents]

    def derivative(self, i: int) -> list[tuple[int, int, int]]:
        """`(k, l, e)`: differentiating monomial `k` along `t_i` gives `e` times monomial `l`."""
        lowered = lambda a: tuple(e - (n == i) for n, e in enumerate(a))
        return [(k, self.index[lowered(a)], a[i]) for k, a in enumerate(self.exponents) if a[i]]


monomials = cache(Monomials)


def upward(radius: Tensor) -> Tensor:
    """``radius``, a sum of products of numbers >= 0, with room for the rounding of its own computation."""
    return radius * UPWARD + SMALLEST


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
        return TaylorModel(
            self.coefficients[(slice(None), slice(None), *index)], self.radius[(slice(None), *index)], self.basis
        )

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

    def compose(self, series: Sequence[Tensor], error: Tensor | float, top: Tensor) -> TaylorModel:
        r"""`g` of this model, from `g`'s Taylor coefficients ``series`` at the constant term, each known up to ``error``
        relative to itself, and ``top``, a bound of `|g^{(m+1)}| / (m+1)!` over `range`, with `m` the degree."""
        moving = self.coefficients.clone()
        moving[0] = 0.0
        delta = TaylorModel(moving, self.radius, self.basis)
        reach = upward(delta.size + delta.radius)
        result = TaylorModel.constant(series[-1], error * series[-1].abs(), self.basis)
        for coefficient in reversed(series[:-1]):
            result = result * delta + TaylorModel.constant(coefficient, error * coefficient.abs(), self.basis)
        return TaylorModel(
            result.coefficients, upward(result.radius + top * reach ** (self.basis.degree + 1)), self.basis
        )

    def where(self, condition: Tensor, other: TaylorModel) -> TaylorModel:
        """This model in the cells where ``condition`` holds, ``other`` elsewhere."""
        coefficients = torch.where(condition, self.coefficients, other.coefficients)
        return TaylorModel(coefficients, torch.where(condition, self.radius, other.radius), self.basis)

    def absolute(self) -> TaylorModel:
        """`|g|`: where the sign is not known, the chord over the range of `g`, exact at both ends, less half its height."""
        low, high = self.bounds()
        crosses = (low < 0.0) & (high > 0.0)
        width = torch.where(crosses, high - low, 1.0)
        height = -2.0 * low * high / width
        chord = self * ((high + low) / width) + 0.5 * height
        chord = TaylorModel(
            chord.coefficients, upward(chord.radius + 0.5 * height.abs() + ROUNDING * width), self.basis
        )
        signed = self * torch.where(low >= 0.0, 1.0, -1.0).to(low)
        return chord.where(crosses, signed)

    def reciprocal(self) -> TaylorModel:
        """`1 / g` where `g > 0` on the whole cell; an infinite radius elsewhere."""
        centre, (low, _), degree = self.coefficients[0], self.bounds(), self.basis.degree
        usable = low > 0.0
        centre, safe = torch.where(usable, centre, 1.0), torch.where(usable, low, 1.0)
        series = [(-1.0) ** k * centre ** -(k + 1.0) for k in range(degree + 1)]
        found = self.compose(series, ROUNDING, upward(safe ** -(degree + 2.0)))
        radius = torch.where(usable, found.radius, math.inf)
        return TaylorModel(found.coefficients, radius, self.basis)

    def power(self, exponent: float) -> TaylorModel:
        """`g^exponent`, ``exponent > 0``, of a `g >= 0`; near its zeros only the range is kept."""
        if exponent == 1.0:
            return self
        degree = self.basis.degree
        low, high = self.bounds()
        low, high = low.clamp_min(0.0), high.clamp_min(0.0)
        smooth = low > 0.25 * high
        centre = torch.where(smooth, self.coefficients[0], 1.0)
        binomials = list(
            itertools.accumulate(range(degree + 1), lambda b, k: b * (exponent - k) / (k + 1), initial=1.0)
        )
        series = [binomials[k] * centre ** (exponent - k) for k in range(degree + 1)]
        ends = [torch.where(smooth, end, 1.0) ** (exponent - degree - 1) for end in (low, high)]
        top = upward(abs(binomials[-1]) * torch.maximum(*ends))
        # What the rounded exponent changes grows with it and with the logarithm of the base, below 745.
        relative = ROUNDING * (16.0 + 8.0 * exponent)
        found = self.compose(series, relative, top)
        least, most = low**exponent * (1.0 - relative), high**exponent * (1.0 + relative)
        hull = TaylorModel.constant(0.5 * (least + most), upward(0.5 * (most - least) + ROUNDING * most), self.basis)
        return found.where(smooth, hull)


@dataclass(frozen=True)
class Box:
    """`N` cells with ``centre`` and half-widths ``half``, both ``(N, d)`` and dyadic, so that both are exact."""

    centre: Tensor
    half: Tensor
    degree: int

    @property
    def basis(self) -> Monomials:
        return monomials(self.centre.shape[1], self.degree)

    def __len__(self) -> int:
        return len(self.centre)

    def coordinates(self) -> TaylorModel:
        """The model of `x` itself, ``(N, d)``."""
        basis = self.basis
        coefficients = self.centre.new_zeros(basis.count, *self.centre.shape)
        coefficients[0] = self.centre
        for i in range(basis.dim):
            unit = tuple(int(n == i) for n in range(basis.dim))
            coefficients[basis.index[unit], :, i] = self.half[:, i]
        return TaylorModel(coefficients, torch.zeros_like(self.centre), basis)

    def constant(self, value: Tensor | float, radius: Tensor | float = 0.0) -> TaylorModel:
        """A model of a function known up to ``radius`` by ``value``, ``(N, ...)`` or one number for all cells."""
        value = torch.as_tensor(value, dtype=self.centre.dtype, device=self.centre.device)
        value = value if value.dim() else value.expand(len(self))
        return TaylorModel.constant(value, torch.as_tensor(radius, dtype=value.dtype).expand(value.shape), self.basis)

    def cosine(self, waves: Tensor, phases: Tensor) -> TaylorModel:
        """`cos(2 pi k_j . x + theta_j)` for integer ``waves`` `k` ``(J, d)`` and ``phases`` ``(J,)``: ``(N, J)``."""
        basis, degree = self.basis, self.degree
        # k . c is exact for dyadic c, and so is taking whole turns from it.
        angle = 2.0 * math.pi * (self.centre @ waves.T).remainder(1.0) + phases
        frequency = 2.0 * math.pi * self.half.unsqueeze(1) * waves
        turns = [(angle + 0.5 * math.pi * (k % 4)).cos() for k in range(min(degree + 1, 4))]
        coefficients = angle.new_empty(basis.count, *angle.shape)
        for k, alpha in enumerate(basis.exponents):
            scale = math.prod(math.factorial(e) for e in alpha)
            coefficients[k] = turns[sum(alpha) % 4] * (frequency ** angle.new_tensor(alpha)).prod(dim=-1) / scale
        reach = frequency.abs().sum(dim=-1)
        left_out = reach ** (degree + 1) / math.factorial(degree + 1)
        rounding = ROUNDING * (8.0 + angle.abs()) * reach.exp()
        return TaylorModel(coefficients, upward(left_out + rounding), basis)
