"""One-dimensional problems on a fine grid, solved literally: the truth that adversarial problems are held against.

A controlled Markov chain that jumps to the next node with the wind (Kushner and Dupuis), by policy iteration. Its error is of
the order of the distance of nodes; two grids, one twice as fine, enclose the truth between twice their difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

NODES = 2**12
# Policy iteration carries news of a cheap place one node at a time: grids of so many nodes on, twice as fine each, start from
# the policy of the one before, which sees the cheapest state of each of its cells.
COARSEST, ITERATIONS = 2**6, 200
Function = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Line:
    """`dy = (a + b u) dt` at cost `f + |u|^q / q` on the circle, from ``start``, a normal law `(centre, sigma)`, or uniform
    where that is `None`. All are functions of states ``(N,)``."""

    f: Function
    a: Function | None = None
    b: Function | None = None  # None: 1
    start: tuple[float, float] | None = None

    @property
    def moves(self) -> bool:
        """Whether a control moves anything."""
        return self.b is None or bool((self.b(torch.linspace(0.0, 1.0, 101)) != 0.0).any())

    def optimum(self, rho: float, q: float) -> tuple[float, float]:
        """An enclosure of OPT."""
        coarse, fine = (self._mean(self.value(rho, q, n)) for n in (NODES // 2, NODES))
        return fine - 2.0 * abs(fine - coarse) - 1e-9, fine + 2.0 * abs(fine - coarse) + 1e-9

    def idle(self, rho: float) -> tuple[float, float]:
        """An enclosure of what doing nothing costs."""
        return Line(self.f, self.a, torch.zeros_like, self.start).optimum(rho, 2.0)

    def _mean(self, value: np.ndarray) -> float:
        if self.start is None:
            return float(value.mean())
        z = np.linspace(-7.0, 7.0, 2001)
        weight = np.exp(-0.5 * z**2)
        at = (self.start[0] + self.start[1] * z) % 1.0
        nodes = np.arange(len(value) + 1) / len(value)
        return float(weight @ np.interp(at, nodes, np.append(value, value[0])) / weight.sum())

    def value(self, rho: float, q: float, n: int = NODES) -> np.ndarray:
        """`V*` at ``n`` nodes `k / n`."""
        y = torch.arange(n, dtype=torch.float64) / n
        f, size, u = self.f(y).numpy(), COARSEST, np.zeros(COARSEST)
        while True:
            value, u = self._solved(f.reshape(size, -1).min(axis=1), y[:: n // size], rho, q, u)
            if size == n:
                return value
            size, u = 2 * size, u.repeat(2)

    def _solved(self, f: np.ndarray, y: torch.Tensor, rho: float, q: float, u: np.ndarray):
        """`V` and `u` at nodes ``y`` for the cost ``f`` there, from the policy ``u``."""
        n, h, conjugate = len(f), 1.0 / len(f), q / (q - 1.0)
        a = np.zeros(n) if self.a is None else self.a(y).numpy()
        b = np.ones(n) if self.b is None else self.b(y).numpy()
        moves = b != 0.0
        still = np.where(moves, -a / np.where(moves, b, 1.0), 0.0)
        cost = lambda u: np.abs(u) ** q / q
        value = None
        for _ in range(ITERATIONS):
            up, down = np.maximum(a + b * u, 0.0) / h, np.maximum(-a - b * u, 0.0) / h
            new = solved(rho + up + down, up, down, rho * (f + cost(u)))
            if value is not None and np.abs(new - value).max() <= 1e-12 * (1.0 + np.abs(new).max()):
                return new, u
            value = new
            ahead, behind = (np.roll(value, -1) - value) / h, (value - np.roll(value, 1)) / h
            greedy = [-np.sign(b * p) * np.abs(b * p / rho) ** (conjugate - 1.0) for p in (ahead, behind)]
            # A control that blows against the difference it was chosen by stands still instead, where it can.
            greedy[0] = np.where(moves & (a + b * greedy[0] < 0.0), still, greedy[0])
            greedy[1] = np.where(moves & (a + b * greedy[1] > 0.0), still, greedy[1])
            tried = np.stack([u, still, np.zeros(n), *greedy])
            g = a + b * tried
            paid = cost(tried) + (np.maximum(g, 0.0) * ahead - np.maximum(-g, 0.0) * behind) / rho
            u = tried[paid.argmin(axis=0), np.arange(n)]
        raise ArithmeticError("policy iteration does not settle")


def solved(middle: np.ndarray, up: np.ndarray, down: np.ndarray, right: np.ndarray) -> np.ndarray:
    """`x` with `middle_k x_k - up_k x_{k+1} - down_k x_{k-1} = right_k` around a circle: elimination from one end, with the
    link between the ends put back in (Sherman and Morrison)."""
    n, corner = len(right), -float(middle[0])
    link = np.zeros(n)
    link[0], link[-1] = corner, -up[-1]
    m = middle.copy()
    m[0] -= corner
    m[-1] -= down[0] * up[-1] / corner
    x, z = _along(m.tolist(), up.tolist(), down.tolist(), np.stack([right, link]).T.tolist())
    beside = -float(down[0]) / corner
    return x - z * (x[0] + beside * x[-1]) / (1.0 + z[0] + beside * z[-1])


def _along(m: list, up: list, down: list, right: list) -> tuple[np.ndarray, np.ndarray]:
    n, factors = len(m), [0.0] * len(m)
    one, two = [0.0] * n, [0.0] * n
    factors[0], one[0], two[0] = up[0] / m[0], right[0][0] / m[0], right[0][1] / m[0]
    for k in range(1, n):
        pivot = m[k] - down[k] * factors[k - 1]
        factors[k] = up[k] / pivot
        one[k] = (right[k][0] + down[k] * one[k - 1]) / pivot
        two[k] = (right[k][1] + down[k] * two[k - 1]) / pivot
    for k in range(n - 2, -1, -1):
        one[k] += factors[k] * one[k + 1]
        two[k] += factors[k] * two[k + 1]
    return np.array(one), np.array(two)
