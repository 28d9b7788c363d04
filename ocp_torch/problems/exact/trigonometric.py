"""Trigonometric polynomials on the torus, with the derivatives and Poisson solves that manufactured problems need."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class TrigonometricPolynomial:
    """`p(x) = c + sum_j b_j cos(2 pi k_j . x + theta_j)` with integer wave vectors `k_j != 0`.

    ``waves`` ``(J, d)``, ``amplitudes`` and ``phases`` ``(J,)``, all float64; evaluated in the precision of `x`.
    """

    def __init__(self, waves: Tensor, amplitudes: Tensor, phases: Tensor, constant: float = 0.0) -> None:
        self.waves, self.amplitudes, self.phases, self.constant = waves, amplitudes, phases, constant

    def scaled(self, factor: float) -> TrigonometricPolynomial:
        """`factor * p`."""
        return TrigonometricPolynomial(self.waves, factor * self.amplitudes, self.phases, factor * self.constant)

    def inverse_laplacian(self) -> TrigonometricPolynomial:
        """The mean-free `phi` with `Laplace(phi) = p - c`, mode by mode."""
        symbol = -((2.0 * math.pi) ** 2) * self.waves.square().sum(dim=1)
        return TrigonometricPolynomial(self.waves, self.amplitudes / symbol, self.phases)

    def minus(self, other: TrigonometricPolynomial) -> TrigonometricPolynomial:
        """`p - other`."""
        return TrigonometricPolynomial(
            torch.cat([self.waves, other.waves]),
            torch.cat([self.amplitudes, -other.amplitudes]),
            torch.cat([self.phases, other.phases]),
            self.constant - other.constant,
        )

    def integral_with(self, other: TrigonometricPolynomial) -> float:
        """`int p q` over the torus: cosines of different wave vectors are orthogonal, equal or opposite ones are not."""
        total = self.constant * other.constant
        for k, b, theta in zip(self.waves, self.amplitudes, self.phases, strict=True):
            for l, c, eta in zip(other.waves, other.amplitudes, other.phases, strict=True):
                if torch.equal(k, l):
                    total += 0.5 * float(b * c * torch.cos(theta - eta))
                elif torch.equal(k, -l):
                    total += 0.5 * float(b * c * torch.cos(theta + eta))
        return total

    def _angle(self, x: Tensor) -> Tensor:
        return 2.0 * math.pi * (x @ self.waves.to(x).T) + self.phases.to(x)

    def __call__(self, x: Tensor) -> Tensor:
        """`p(x)`, ``(N,)``."""
        return self.constant + self._angle(x).cos() @ self.amplitudes.to(x)

    def gradient(self, x: Tensor) -> Tensor:
        """`grad p(x)`, ``(N, d)``."""
        slopes = -2.0 * math.pi * self.amplitudes.to(x) * self._angle(x).sin()
        return slopes @ self.waves.to(x)

    def hessian(self, x: Tensor) -> Tensor:
        """Second derivatives of `p`, ``(N, d, d)``."""
        curvatures = -((2.0 * math.pi) ** 2) * self.amplitudes.to(x) * self._angle(x).cos()
        return torch.einsum("nj,ji,jk->nik", curvatures, self.waves.to(x), self.waves.to(x))


def random_waves(dim: int, interaction: int, count: int, generator: torch.Generator) -> Tensor:
    """``count`` wave vectors, each with exactly `min(interaction, dim)` non-zero entries, that together use every
    coordinate; in one coordinate the frequencies are 1, 2, ..., otherwise each entry is +-1 or (one in four) +-2."""
    order = min(interaction, dim)
    waves = torch.zeros(count, dim, dtype=torch.float64)
    if dim == 1:
        waves[:, 0] = torch.arange(1, count + 1, dtype=torch.float64)
        return waves
    for j in range(count):
        others = [i for i in torch.randperm(dim, generator=generator).tolist() if i != j % dim]
        support = [j % dim, *others[: order - 1]]
        signs = 2.0 * torch.randint(2, (order,), generator=generator).double() - 1.0
        doubled = 1.0 + (torch.rand(order, generator=generator) < 0.25).double()
        waves[j, support] = signs * doubled
    return waves


def random_polynomial(
    dim: int, interaction: int, count: int, generator: torch.Generator, peak: Tensor | None = None
) -> TrigonometricPolynomial:
    """A random mean-free polynomial whose absolute amplitudes sum to 1; with ``peak`` ``(d,)`` it attains 1 there."""
    waves = random_waves(dim, interaction, count, generator)
    size = 0.5 + torch.rand(count, generator=generator, dtype=torch.float64)
    amplitudes = size / waves.square().sum(dim=1)
    if peak is None:
        phases = 2.0 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    else:
        phases = -2.0 * math.pi * (waves @ peak)
    return TrigonometricPolynomial(waves, amplitudes / amplitudes.sum(), phases)
