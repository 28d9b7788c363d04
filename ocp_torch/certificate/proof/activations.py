r"""Taylor coefficients of the smooth activations, and proved bounds of their derivatives on the whole line.

Each class gives `s_k = sigma^{(k)}(z) / k!`; ``error(k)``, an absolute bound of its rounding (times `1 + |z|` for `k = 0`);
and ``ceiling(k) >= sup_z |s_k|`` for `k >= 1`. The ceilings come from Cauchy's estimate, `sup |g^{(k)}| / k! <=
sup_{|Im z| <= R} |g| / R^k`, on strips where the function is bounded. Library exp, erf, tanh and log1p are assumed to be
accurate to 16 units in the last place.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

# Rounding of one derivative relative to the sum of its terms.
RELATIVE = 2.0**-46
Polynomial = list[float]


def _plus(p: Polynomial, q: Polynomial) -> Polynomial:
    longer = max(len(p), len(q))
    return [(p[i] if i < len(p) else 0.0) + (q[i] if i < len(q) else 0.0) for i in range(longer)]


def _times(p: Polynomial, q: Polynomial) -> Polynomial:
    product = [0.0] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            product[i + j] += a * b
    return product


def _slope(p: Polynomial) -> Polynomial:
    return [i * a for i, a in enumerate(p)][1:] or [0.0]


def _horner(p: Polynomial, z: Tensor) -> Tensor:
    result = torch.full_like(z, p[-1])
    for a in reversed(p[:-1]):
        result = result * z + a
    return result


def _family(start: Polynomial, step, count: int) -> list[Polynomial]:
    family = [start]
    while len(family) < count:
        family.append(step(family[-1]))
    return family


class Gelu:
    r"""`z Phi(z)`, with the normal distribution function `Phi` and density `phi`: `sigma^{(k)} = q_k phi` from `k = 2` on."""

    def __init__(self, order: int) -> None:
        hermite = lambda q: _plus(_slope(q), _times([0.0, -1.0], q))
        self.q = [[0.0], [0.0], *_family([2.0, 0.0, -1.0], hermite, order)]

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        cut = z.clamp(-38.0, 38.0)  # beyond, phi and every derivative underflow
        density = (-0.5 * cut.square()).exp() / math.sqrt(2.0 * math.pi)
        distribution = 0.5 * torch.erfc(-z / math.sqrt(2.0))
        first = [z * distribution, distribution + cut * density]
        return first + [_horner(self.q[k], cut) * density / math.factorial(k) for k in range(2, order + 1)]

    def error(self, k: int) -> float:
        peak = lambda j: (j / math.e) ** (j / 2) if j else 1.0  # sup |z|^j e^{-z^2/2}
        terms = [abs(a) * (peak(j) + peak(j + 2)) for j, a in enumerate(self.q[k])]
        return RELATIVE * (4.0 + sum(terms)) / math.factorial(k)

    def ceiling(self, k: int) -> float:
        if k == 1:
            return 1.13
        # |(2 - z^2) phi| <= (2 + R^2) e^{R^2/2} / sqrt(2 pi) on the strip |Im z| <= R.
        radii = [0.05 * i for i in range(10, 80)]
        best = min(0.4 * (2.0 + R * R) * math.exp(0.5 * R * R) * R ** (2 - k) for R in radii)
        return best / (k * (k - 1))


class Tanh:
    r"""`sigma^{(k)}` is a polynomial in `T = tanh z`; `|tanh| <= 1` on the strip `|Im z| <= pi/4`."""

    def __init__(self, order: int) -> None:
        self.q = _family([0.0, 1.0], lambda q: _times([1.0, 0.0, -1.0], _slope(q)), order + 1)

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        T = z.tanh()
        return [_horner(self.q[k], T) / math.factorial(k) for k in range(order + 1)]

    def error(self, k: int) -> float:
        return RELATIVE * sum((j + 1) * abs(a) for j, a in enumerate(self.q[k])) / math.factorial(k)

    def ceiling(self, k: int) -> float:
        return (4.0 / math.pi) ** k * UP


# The ceilings are computed in floating point themselves.
UP = 1.0 + 1e-12


class _Sigmoid:
    r"""`s = 1 / (1 + e^{-z})` and `s^{(k)} = s (1 - s) q_k(s)`; on `|Im z| <= pi/2`, `|s - 1/2| <= 1/2` and `|s| <= 1`."""

    def __init__(self, order: int) -> None:
        step = lambda q: _plus(_times([1.0, -2.0], q), _times([0.0, 1.0, -1.0], _slope(q)))
        self.q = [[0.0], *_family([1.0], step, order)]

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        small = (-z.abs()).exp()
        s = torch.where(z < 0.0, small, 1.0) / (1.0 + small)
        product = small / (1.0 + small).square()
        return [s, *(product * _horner(self.q[k], s) / math.factorial(k) for k in range(1, order + 1))]

    def error(self, k: int) -> float:
        return RELATIVE * (1.0 + sum((j + 1) * abs(a) for j, a in enumerate(self.q[k]))) / math.factorial(k)


class Softplus:
    r"""`log(1 + e^z)`, whose derivative is the sigmoid."""

    def __init__(self, order: int) -> None:
        self.s = _Sigmoid(order)

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        sigmoid = self.s.series(z, order - 1)
        value = z.clamp_min(0.0) + (-z.abs()).exp().log1p()
        return [value, *(s / (k + 1.0) for k, s in enumerate(sigmoid))]

    def error(self, k: int) -> float:
        return RELATIVE if k == 0 else self.s.error(k - 1)

    def ceiling(self, k: int) -> float:
        return UP if k == 1 else 0.5 * (2.0 / math.pi) ** (k - 1) / k * UP


class Silu:
    r"""`z s(z)`, `sigma^{(k)} = z s^{(k)} + k s^{(k-1)}`; `|sigma'| <= |s| + |z s'| <= 1 + 0.92` on `|Im z| <= pi/2`.

    There `|s'| = 1 / (4 |cosh(z/2)|^2) <= 1 / (2 cosh Re z)`, and `(x + pi/2) / (2 cosh x) <= 0.92`.
    """

    def __init__(self, order: int) -> None:
        self.s = _Sigmoid(order)

    def series(self, z: Tensor, order: int) -> list[Tensor]:
        sigmoid = self.s.series(z, order)
        return [z * sigmoid[0], *(z * sigmoid[k] + sigmoid[k - 1] for k in range(1, order + 1))]

    def error(self, k: int) -> float:
        return RELATIVE * 2.0 if k == 0 else self.s.error(k) + self.s.error(k - 1)

    def ceiling(self, k: int) -> float:
        return 1.93 * (2.0 / math.pi) ** (k - 1) / k * UP


class Series(Protocol):
    """What each of them gives, for derivatives up to an order."""

    def series(self, z: Tensor, order: int) -> list[Tensor]: ...

    def error(self, k: int) -> float: ...

    def ceiling(self, k: int) -> float: ...


Activation = type[torch.nn.Module]
SERIES: dict[Activation, Callable[[int], Series]] = {
    torch.nn.GELU: Gelu,
    torch.nn.Tanh: Tanh,
    torch.nn.Softplus: Softplus,
    torch.nn.SiLU: Silu,
}
