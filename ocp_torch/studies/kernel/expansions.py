r"""A field in the space, for `R` independent runs: by truncated features, or exactly by the kernel at all past states.

Both move along `sum_a c_a d_a Phi(x)` at one state `x` (`d_0 Phi = Phi`), whose coefficients a rule gives, and tell their
jets at one state. ``mark`` and ``restore`` go back to where a look-ahead began.
"""

import math
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np
import torch

from ocp_torch.errors import require_integer
from ocp_torch.fields.sobolev import SobolevFeatures, SobolevField
from ocp_torch.studies.kernel.rules import Datum


def bernoulli_polynomial(n: int) -> list[Fraction]:
    """Coefficients of `B_n`, constant first: `B_n(x) = sum_k C(n, k) B_{n-k} x^k` with Bernoulli numbers `B_k`."""
    numbers = [Fraction(1)]
    for j in range(1, n + 1):
        numbers.append(-sum(math.comb(j + 1, k) * numbers[k] for k in range(j)) / Fraction(j + 1))
    return [math.comb(n, k) * numbers[n - k] for k in range(n + 1)]


class BernoulliKernel:
    r"""The exact kernel `K(x, y) = prod_i kappa(x_i - y_i)` of the periodic Sobolev space of ``regularity`` `s`.

    `kappa(t) = 1 + (-1)^{s+1} (2 pi)^{2s} / (2s)! B_{2s}({t})` has the Fourier coefficients 1 and `|w|^{-2s}`; for `s = 2` it
    is the kernel of the paper's example (section 4.4). One needs derivatives up to the second, hence `s >= 2`; polynomials of
    high degree lose digits, hence `s <= 8`. Raises `InputError` for any other than a whole number in between.
    """

    def __init__(self, regularity: int = 2) -> None:
        self.regularity = s = require_integer("regularity", regularity, 2, maximum=8)
        sign = (-1) ** (s + 1) * (2.0 * math.pi) ** (2 * s)
        # B_n' = n B_{n-1}; highest power first, as np.polyval takes them.
        self._polynomials = [
            [sign / math.factorial(2 * s - k) * float(c) for c in reversed(bernoulli_polynomial(2 * s - k))]
            for k in (0, 1, 2)
        ]
        self._polynomials[0][-1] += 1.0

    def derivatives(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`kappa`, `kappa'` and `kappa''` at each entry of ``t``."""
        t = t - np.floor(t)
        value, slope, curvature = (np.polyval(polynomial, t) for polynomial in self._polynomials)
        return value, slope, curvature

    def jets(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Of `K(x, y)`, ``(..., d)`` each: value and derivatives in `x` by value and derivatives in `y`.

        Entry ``[..., a, b]`` of ``(..., 1 + d, 1 + d)`` is differentiated in `x_a` and in `y_b`, and not for index 0.
        """
        factors = self.derivatives(x - y)
        d = factors[0].shape[-1]
        block = np.empty((*factors[0].shape[:-1], 1 + d, 1 + d))
        for a in range(1 + d):
            for b in range(1 + d):
                # In each coordinate the order of the derivative; one in y changes the sign.
                entry = reduce(np.multiply, (factors[(i + 1 == a) + (i + 1 == b)][..., i] for i in range(d)))
                block[..., a, b] = -entry if b > 0 else entry
        return block


class FeatureExpansion:
    """`V = theta . features`: a step costs the same at every `n`. ``radius`` is that of the ball it is projected on."""

    def __init__(self, features: SobolevFeatures, runs: int, outputs: int, radius: float | None) -> None:
        self.features, self.radius = features, radius
        self.theta = np.zeros((runs, features.count, outputs))
        self.total, self.count = np.zeros_like(self.theta), 0

    def jet(self, datum: Datum) -> np.ndarray:
        """Value and gradient at the datum's state, ``(R, 1 + d, o)``."""
        return np.matmul(datum.jets, self.theta)

    def move(self, step: np.ndarray, datum: Datum) -> None:
        """Add the element with coefficients ``step`` ``(R, 1 + d, o)`` at the datum's state, and project."""
        self.theta = self.theta + np.matmul(datum.jets.transpose(0, 2, 1), step)
        if self.radius is not None:
            norm = np.sqrt(np.square(self.theta).sum(axis=(1, 2), keepdims=True))
            self.theta *= np.minimum(1.0, self.radius / np.maximum(norm, 1e-300))

    def mark(self) -> np.ndarray:
        return self.theta

    def restore(self, mark: Any) -> None:
        self.theta = mark

    def visit(self) -> None:
        """Count the present iterate in the average."""
        self.total += self.theta
        self.count += 1

    @torch.no_grad()
    def field(self, run: int, scalar: bool) -> SobolevField:
        """The averaged iterate of one run as a float64 network in units of 1; ``(N,)`` if ``scalar``."""
        theta = self.total[run] / max(self.count, 1)
        field = SobolevField.of(self.features, None if scalar else theta.shape[1]).double()
        field.coefficients.copy_(torch.from_numpy(theta[:, 0] if scalar else theta.T))
        return field.requires_grad_(False)


class KernelExpansion:
    """`V = sum_k alpha_k Phi(x_k) + sum_i beta_ki d_i Phi(x_k)` (Propositions 5, 7 and 10): a step costs `O(n)`.

    Holds ``capacity`` states at most. The norm is kept up to date by the reproducing property.
    """

    def __init__(
        self, kernel: BernoulliKernel, dim: int, capacity: int, runs: int, outputs: int, radius: float | None
    ) -> None:
        self.kernel, self.radius, self.known = kernel, radius, 0
        self.x = np.zeros((runs, capacity, dim))
        self.coefficients = np.zeros((runs, capacity, 1 + dim, outputs))
        self.total, self.count = np.zeros_like(self.coefficients), 0
        self.squared_norm = np.zeros(runs)
        self._own = kernel.jets(np.zeros(dim), np.zeros(dim))

    def jet(self, datum: Datum) -> np.ndarray:
        """Value and gradient at the datum's state, ``(R, 1 + d, o)``."""
        return self.at(datum.x[:, None])[:, 0]

    def at(self, x: np.ndarray, average: bool = False) -> np.ndarray:
        """Jets ``(R, N, 1 + d, o)`` at states ``(R or 1, N, d)`` of the present, or of the averaged, iterate."""
        n = self.known
        coefficients = self.total[:, :n] / max(self.count, 1) if average else self.coefficients[:, :n]
        blocks = self.kernel.jets(self.x[:, None, :n], x[:, :, None])  # (R, N, n, 1 + d, 1 + d)
        runs, states, _, width, _ = blocks.shape
        rows = blocks.reshape(runs, states, n * width, width).swapaxes(-1, -2)
        return np.matmul(rows, coefficients.reshape(len(self.x), 1, n * width, self.coefficients.shape[-1]))

    def move(self, step: np.ndarray, datum: Datum) -> None:
        """Add the element with coefficients ``step`` ``(R, 1 + d, o)`` at the datum's state, and project."""
        if self.radius is not None:
            own = np.einsum("rao,ab,rbo->r", step, self._own, step)
            self.squared_norm = self.squared_norm + 2.0 * (self.jet(datum) * step).sum(axis=(1, 2)) + own
        self.x[:, self.known] = datum.x
        self.coefficients[:, self.known] = step
        self.known += 1
        if self.radius is not None:
            norm = np.sqrt(np.maximum(self.squared_norm, 1e-300))
            factor = np.minimum(1.0, self.radius / norm)
            self.coefficients[:, : self.known] *= factor[:, None, None, None]
            self.squared_norm = self.squared_norm * factor**2

    def mark(self) -> tuple[np.ndarray, np.ndarray]:
        return self.coefficients[:, : self.known].copy(), self.squared_norm

    def restore(self, mark: Any) -> None:
        """States added since then stay, with the coefficient 0: the average may hold them."""
        coefficients, self.squared_norm = mark
        kept = coefficients.shape[1]
        self.coefficients[:, :kept] = coefficients
        self.coefficients[:, kept : self.known] = 0.0

    def visit(self) -> None:
        """Count the present iterate in the average."""
        self.total[:, : self.known] += self.coefficients[:, : self.known]
        self.count += 1
