r"""The exact kernel of the periodic Sobolev space of whole regularity `s`, and its first and second derivatives.

`kappa(t) = 1 + (-1)^{s+1} (2 pi)^{2s} / (2s)! B_{2s}({t})`, whose Fourier coefficients are 1 and `|w|^{-2s}`; for `s = 2` the
kernel of the paper's example (section 4.4). In several dimensions the product of one such kernel per coordinate.
"""

import math
from fractions import Fraction

import numpy as np

from ocp_torch.errors import require_integer


def bernoulli_polynomial(n: int) -> list[Fraction]:
    """Coefficients of `B_n`, constant first: `B_n(x) = sum_k C(n, k) B_{n-k} x^k` with Bernoulli numbers `B_k`."""
    numbers = [Fraction(1)]
    for j in range(1, n + 1):
        numbers.append(-sum(math.comb(j + 1, k) * numbers[k] for k in range(j)) / Fraction(j + 1))
    return [math.comb(n, k) * numbers[n - k] for k in range(n + 1)]


class BernoulliKernel:
    """`K(x, y) = prod_i kappa(x_i - y_i)`. Raises `InputError` unless ``regularity`` is a whole number from 2 to 8.

    One needs derivatives up to the second, hence `s >= 2`; polynomials of high degree lose digits, hence `s <= 8`.
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
                entry = math.prod(factors[(i + 1 == a) + (i + 1 == b)][..., i] for i in range(d))
                block[..., a, b] = -entry if b > 0 else entry
        return block
