"""A batch of cells of the torus, and the Taylor models that all others are made of: coordinates, constants and cosines, and
`|g|`, `1 / g` and powers of a model `g`, by expansion about its constant term where they are smooth."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.proof.taylor import ROUNDING, Monomials, TaylorModel, monomials, upward

# `power` expands where the lower bound of g is above this part of the upper one. Nearer to a zero of g, where a power may
# not be smooth, the range is as good as an expansion.
SMOOTH = 0.25
# Error of a computed g^e relative to itself, in units of ROUNDING: the first number plus e times the second. As
# |log g| <= 745 in float64, an exponent off by 2^-53 e changes g^e by less than 2 e ROUNDING.
POWER_ERROR = (16.0, 8.0)


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
        coefficients = self.centre.new_zeros(len(basis.exponents), *self.centre.shape)
        coefficients[0] = self.centre
        for i in range(basis.dim):
            unit = tuple(int(n == i) for n in range(basis.dim))
            coefficients[basis.index[unit], :, i] = self.half[:, i]
        return TaylorModel(coefficients, torch.zeros_like(self.centre), basis)

    def constant(self, value: Tensor | float, radius: Tensor | float = 0.0) -> TaylorModel:
        """A model of a function known up to ``radius`` by ``value``, ``(N, ...)`` or one number for all cells."""
        value, radius = (torch.as_tensor(given, dtype=self.centre.dtype) for given in (value, radius))
        return TaylorModel.constant(value if value.dim() else value.expand(len(self)), radius, self.basis)

    def cosine(self, waves: Tensor, phases: Tensor) -> TaylorModel:
        """`cos(2 pi k_j . x + theta_j)` for integer ``waves`` `k` ``(J, d)`` and ``phases`` ``(J,)``: ``(N, J)``."""
        basis, degree = self.basis, self.degree
        # k . c is exact for dyadic c, and so is taking whole turns from it.
        angle = 2.0 * math.pi * (self.centre @ waves.T).remainder(1.0) + phases
        frequency = 2.0 * math.pi * self.half.unsqueeze(1) * waves
        turns = [(angle + 0.5 * math.pi * (k % 4)).cos() for k in range(min(degree + 1, 4))]
        coefficients = angle.new_empty(len(basis.exponents), *angle.shape)
        for k, alpha in enumerate(basis.exponents):
            scale = math.prod(math.factorial(e) for e in alpha)
            coefficients[k] = turns[sum(alpha) % 4] * (frequency ** angle.new_tensor(alpha)).prod(dim=-1) / scale
        reach = frequency.abs().sum(dim=-1)
        left_out = reach ** (degree + 1) / math.factorial(degree + 1)
        rounding = ROUNDING * (8.0 + angle.abs()) * reach.exp()
        return TaylorModel(coefficients, upward(left_out + rounding), basis)


def equal_cells(dim: int, side: int, degree: int) -> Box:
    """``side`` cells per coordinate that cover the torus; ``side`` is a power of two, so that centres are exact."""
    edges = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    centre = torch.cartesian_prod(*[edges] * dim).reshape(-1, dim)
    return Box(centre, torch.full_like(centre, 0.5 / side), degree)


def compose(g: TaylorModel, series: Sequence[Tensor], error: Tensor | float, top: Tensor) -> TaylorModel:
    r"""`s(g)`, from the Taylor coefficients ``series`` of `s` at the constant term of ``g``.

    Each of ``series`` ``(N, ...)`` is known up to ``error`` relative to itself; ``top`` bounds `|s^{(m+1)}| / (m+1)!` over
    the range of ``g``, with `m` the degree.
    """
    moving = g.coefficients.clone()
    moving[0] = 0.0
    delta = TaylorModel(moving, g.radius, g.basis)
    reach = upward(delta.size + delta.radius)
    result = TaylorModel.constant(series[-1], error * series[-1].abs(), g.basis)
    for coefficient in reversed(series[:-1]):
        result = result * delta + TaylorModel.constant(coefficient, error * coefficient.abs(), g.basis)
    return TaylorModel(result.coefficients, upward(result.radius + top * reach ** (g.basis.degree + 1)), g.basis)


def absolute(g: TaylorModel) -> TaylorModel:
    """`|g|`. Where the sign of `g` is unknown, the model is the chord over its range, which is exact at both ends and too
    high by at most its height at 0, less half of that height."""
    low, high = g.bounds()
    crosses = (low < 0.0) & (high > 0.0)
    width = torch.where(crosses, high - low, 1.0)
    height = -2.0 * low * high / width
    line = g * ((high + low) / width) + 0.5 * height
    radius = upward(line.radius + 0.5 * height.abs() + ROUNDING * width)
    signed = g * torch.where(low >= 0.0, 1.0, -1.0).to(low)
    return TaylorModel(line.coefficients, radius, g.basis).where(crosses, signed)


def reciprocal(g: TaylorModel) -> TaylorModel:
    """`1 / g` where `g > 0` on the whole cell; an infinite radius elsewhere."""
    centre, (low, _), degree = g.coefficients[0], g.bounds(), g.basis.degree
    usable = low > 0.0
    centre, safe = torch.where(usable, centre, 1.0), torch.where(usable, low, 1.0)
    series = [(-1.0) ** k * centre ** -(k + 1.0) for k in range(degree + 1)]
    found = compose(g, series, ROUNDING, upward(safe ** -(degree + 2.0)))
    return TaylorModel(found.coefficients, torch.where(usable, found.radius, math.inf), g.basis)


def power(g: TaylorModel, exponent: float) -> TaylorModel:
    """`g^exponent`, ``exponent > 0``, of a `g >= 0`; near the zeros of `g` only the range is kept (see `SMOOTH`)."""
    if exponent == 1.0:
        return g
    degree = g.basis.degree
    low, high = (end.clamp_min(0.0) for end in g.bounds())
    smooth = low > SMOOTH * high
    centre = torch.where(smooth, g.coefficients[0], 1.0)
    binomials = list(itertools.accumulate(range(degree + 1), lambda b, k: b * (exponent - k) / (k + 1), initial=1.0))
    series = [binomials[k] * centre ** (exponent - k) for k in range(degree + 1)]
    ends = [torch.where(smooth, end, 1.0) ** (exponent - degree - 1) for end in (low, high)]
    top = upward(abs(binomials[-1]) * torch.maximum(*ends))
    relative = ROUNDING * (POWER_ERROR[0] + POWER_ERROR[1] * exponent)
    found = compose(g, series, relative, top)
    least, most = low**exponent * (1.0 - relative), high**exponent * (1.0 + relative)
    hull = TaylorModel.constant(0.5 * (least + most), upward(0.5 * (most - least) + ROUNDING * most), g.basis)
    return found.where(smooth, hull)
