"""The exact kernel of the periodic Sobolev spaces of whole regularity, with its derivatives."""

import math
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np

from ocp_torch.errors import require_integer


def bernoulli_polynomial(n: int) -> list[Fraction]:
    """Coefficients of `B_n`, constant first: `B_n(x) = sum_k C(n, k) B_{n-k} x^k` with Bernoulli numbers `B_k`."""
    numbers = [Fraction(1)]
    for j in range(1, n + 1):
        numbers.append(-sum(math.comb(j + 1, k) * numbers[k] for k in range(j)) / Fraction(j + 1))
    return [math.comb(n, k) * numbers[n - k] for k in range(n + 1)]


class BernoulliKernel:
    r"""The exact kernel `K(x, y) = prod_i kappa(x_i - y_i)` of the periodic Sobolev space of ``regularity`` `s`.

    `kappa(t) = 1 + (-1)^{s+1} (2 pi)^{2s} / (2s)! B_{2s}({t})` has the Fourier coefficients 1 and `|w|^{-2s}`; for `s = 2` it
    is the kernel of the paper's example (section 4.4). One needs derivatives up to the second, hence `s >= 2` (with noise up
    to the fourth, hence `s >= 3`); polynomials of high degree lose digits, hence `s <= 8`. Raises `InputError` for any other
    than a whole number in between.
    """

    def __init__(self, regularity: int = 2) -> None:
        self.regularity = s = require_integer("regularity", regularity, 2, maximum=8)
        sign = (-1) ** (s + 1) * (2.0 * math.pi) ** (2 * s)
        # B_n' = n B_{n-1}; highest power first, as np.polyval takes them.
        self._polynomials = [
            [sign / math.factorial(2 * s - k) * float(c) for c in reversed(bernoulli_polynomial(2 * s - k))]
            for k in range(5)
        ]
        self._polynomials[0][-1] += 1.0

    def derivatives(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`kappa`, `kappa'` and `kappa''` at each entry of ``t``."""
        t = t - np.floor(t)
        value, slope, curvature = (np.polyval(polynomial, t) for polynomial in self._polynomials[:3])
        return value, slope, curvature

    def jets(self, x: np.ndarray, y: np.ndarray, D: Any = None, E: Any = None) -> np.ndarray:
        """The jets of `K(x, y)` at ``x`` and ``y``, both ``(..., d)``: value and derivatives in `x` by those in `y`.

        Entry ``[..., a, b]`` of ``(..., 1 + d, 1 + d)`` is differentiated in `x_a` and in `y_b`, and not for index 0. With
        the diffusion ``D`` at `x`, and ``E`` at `y`, ``(..., d, d)``, one more row, and column, is `D : hess` in `x`, and
        in `y`.
        """
        t, d = x - y, x.shape[-1]
        t = t - np.floor(t)
        factors = [np.polyval(p, t) for p in self._polynomials[: 5 if D is not None or E is not None else 3]]
        rows, columns = _functionals(d, D), _functionals(d, E)
        block = np.empty((*t.shape[:-1], len(rows), len(columns)))
        for a, row in enumerate(rows):
            for b, column in enumerate(columns):
                terms = []
                for along, left in row:
                    for across, right in column:
                        # The order of the derivative in each coordinate; each derivative in y changes the sign.
                        term = reduce(np.multiply, (factors[(along + across).count(i)][..., i] for i in range(d)))
                        term = -term if len(across) == 1 else term
                        terms.append(reduce(np.multiply, (w for w in (left, right) if w is not None), term))
                block[..., a, b] = reduce(np.add, terms)
        return block


def _functionals(dim: int, D: Any) -> list[list[tuple[tuple[int, ...], Any]]]:
    """Value, derivatives and, with ``D``, `D : hess`: each a list of pairs of coordinates to differentiate by and a weight,
    `None` for 1."""
    found: list[list[tuple[tuple[int, ...], Any]]] = [[((), None)]]
    found += [[((i,), None)] for i in range(dim)]
    if D is not None:
        found.append([((i, j), D[..., i, j]) for i in range(dim) for j in range(dim)])
    return found
