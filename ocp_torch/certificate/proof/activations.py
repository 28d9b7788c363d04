r"""Taylor coefficients of the smooth activations, and proved bounds of their derivatives on the whole line.

Each class gives, for derivatives up to an ``order``, ``series`` of `s_k = sigma^{(k)}(z) / k!`; ``error(k)``, an absolute
bound of the rounding of `s_k` (times `1 + |z|` for `k = 0`); and ``ceiling(k) >= sup_z |s_k|`` for `k >= 1`. The ceilings
come from Cauchy's estimate, `sup |g^{(k)}| / k! <= sup_{|Im z| <= R} |g| / R^k`, on strips where the function is bounded.
Library exp, erf, tanh and log1p are assumed to be accurate to 16 units in the last place.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import reduce

import torch
from numpy.polynomial import Polynomial
from torch import Tensor, nn

from ocp_torch.fields import activations

# Rounding of one derivative relative to the sum of its terms.
RELATIVE = 2.0**-46
# Factor that covers the rounding of the ceilings themselves.
UP = 1.0 + 1e-12


def horner(coefficients: Sequence, at: Tensor) -> Tensor:
    """The polynomial with ``coefficients``, from the constant on, ``at`` a tensor."""
    return reduce(lambda total, c: total * at + c, reversed(coefficients))


def _family(first: list[float], step: Callable[[Polynomial], Polynomial], count: int) -> list[list[float]]:
    """The coefficients of ``count`` polynomials, each made from the one before."""
    family = itertools.accumulate(range(count - 1), lambda q, _: step(q), initial=Polynomial(first))
    return [q.coef.tolist() for q in family]


class Gelu:
    r"""`z Phi(z)`, with the normal distribution function `Phi` and density `phi`: `sigma^{(k)} = q_k phi` from `k = 2` on."""

    def __init__(self, order: int) -> None:
        self.q = [[0.0], [0.0], *_family([2.0, 0.0, -1.0], lambda q: q.deriv() - Polynomial([0.0, 1.0]) * q, order)]

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        cut = z.clamp(-38.0, 38.0)  # beyond, phi and every derivative underflow
        density = (-0.5 * cut.square()).exp() / math.sqrt(2.0 * math.pi)
        distribution = 0.5 * torch.erfc(-z / math.sqrt(2.0))
        first = [z * distribution, distribution + cut * density]
        return first + [horner(self.q[k], cut) * density / math.factorial(k) for k in range(2, order + 1)]

    def error(self, k: int) -> float:
        peak = lambda j: (j / math.e) ** (j / 2) if j else 1.0  # sup |z|^j e^{-z^2/2}
        terms = [abs(a) * (peak(j) + peak(j + 2)) for j, a in enumerate(self.q[k])]
        return RELATIVE * (4.0 + sum(terms)) / math.factorial(k)

    def ceiling(self, k: int) -> float:
        if k == 1:
            return 1.13
        # |(2 - z^2) phi| <= (2 + R^2) e^{R^2/2} / sqrt(2 pi) on the strip |Im z| <= R.
        within = lambda R: 0.4 * (2.0 + R * R) * math.exp(0.5 * R * R) * R ** (2 - k)
        return min(within(0.05 * i) for i in range(10, 80)) / (k * (k - 1))


class Tanh:
    r"""`sigma^{(k)}` is a polynomial in `T = tanh z`; `|tanh| <= 1` on the strip `|Im z| <= pi/4`."""

    def __init__(self, order: int) -> None:
        self.q = _family([0.0, 1.0], lambda q: Polynomial([1.0, 0.0, -1.0]) * q.deriv(), order + 1)

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        T = z.tanh()
        return [horner(self.q[k], T) / math.factorial(k) for k in range(order + 1)]

    def error(self, k: int) -> float:
        return RELATIVE * sum((j + 1) * abs(a) for j, a in enumerate(self.q[k])) / math.factorial(k)

    def ceiling(self, k: int) -> float:
        return (4.0 / math.pi) ** k * UP


class _Sigmoid:
    r"""`s = 1 / (1 + e^{-z})` and `s^{(k)} = s (1 - s) q_k(s)`; on `|Im z| <= pi/2`, `|s - 1/2| <= 1/2` and `|s| <= 1`."""

    def __init__(self, order: int) -> None:
        slope = Polynomial([0.0, 1.0, -1.0])
        self.q = [[0.0], *_family([1.0], lambda q: slope.deriv() * q + slope * q.deriv(), order)]

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        small = (-z.abs()).exp()
        s = torch.where(z < 0.0, small, 1.0) / (1.0 + small)
        product = small / (1.0 + small).square()
        return [s, *(product * horner(self.q[k], s) / math.factorial(k) for k in range(1, order + 1))]

    def error(self, k: int) -> float:
        return RELATIVE * (1.0 + sum((j + 1) * abs(a) for j, a in enumerate(self.q[k]))) / math.factorial(k)


class Softplus(_Sigmoid):
    r"""`log(1 + e^z)`, whose derivative is the sigmoid."""

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        sigmoid = super().series(z, order - 1)
        value = z.clamp_min(0.0) + (-z.abs()).exp().log1p()
        return [value, *(s / (k + 1.0) for k, s in enumerate(sigmoid))]

    def error(self, k: int) -> float:
        return RELATIVE if k == 0 else super().error(k - 1)

    def ceiling(self, k: int) -> float:
        return UP if k == 1 else 0.5 * (2.0 / math.pi) ** (k - 1) / k * UP


class Silu(_Sigmoid):
    r"""`z s(z)`, `sigma^{(k)} = z s^{(k)} + k s^{(k-1)}`; `|sigma'| <= |s| + |z s'| <= 1 + 0.92` on `|Im z| <= pi/2`.

    There `|s'| = 1 / (4 |cosh(z/2)|^2) <= 1 / (2 cosh Re z)`, and `(x + pi/2) / (2 cosh x) <= 0.92`.
    """

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        sigmoid = super().series(z, order)
        return [z * sigmoid[0], *(z * sigmoid[k] + sigmoid[k - 1] for k in range(1, order + 1))]

    def error(self, k: int) -> float:
        return RELATIVE * 2.0 if k == 0 else super().error(k) + super().error(k - 1)

    def ceiling(self, k: int) -> float:
        return 1.93 * (2.0 / math.pi) ** (k - 1) / k * UP


SERIES: dict[type[nn.Module], type[Gelu | Tanh | Softplus | Silu]] = {
    nn.GELU: Gelu,
    activations.Tanh: Tanh,
    nn.Tanh: Tanh,
    nn.Softplus: Softplus,
    nn.SiLU: Silu,
}
