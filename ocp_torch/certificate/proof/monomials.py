"""The monomials that the polynomials of Taylor models are sums of."""

from __future__ import annotations

import itertools
import math
from functools import cache


class Monomials:
    """The exponents `alpha` of the monomials in ``dim`` variables with `|alpha| <= degree`, sorted by degree.

    ``products`` lists `(i, j, k)`: monomial `i` times monomial `j` is monomial `k`, where its degree is not too high.
    ``means`` are the means over `[-1, 1]^dim`; ``even`` says which monomials have even exponents only.
    """

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
