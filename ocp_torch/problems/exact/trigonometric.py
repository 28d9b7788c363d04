"""Trigonometric polynomials on the torus and matrices of waves, with the derivatives that manufactured problems need."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

TURN = 2.0 * math.pi
# How far an entry of a matrix goes up and down, relative to its mean: below 1, so that none changes its sign.
DEPTH = 0.3
# How far the random part of the mean goes from the identity, in standard deviations, before it is divided by sqrt(d): small
# enough that the columns stay apart.
MIX = 0.25


@dataclass(frozen=True)
class TrigonometricPolynomial:
    """`p(x) = c + sum_j b_j cos(2 pi k_j . x + theta_j)` with integer wave vectors `k_j != 0`.

    ``waves`` ``(J, d)``, ``amplitudes`` and ``phases`` ``(J,)``, all float64; evaluated in the precision of `x`.
    """

    waves: Tensor
    amplitudes: Tensor
    phases: Tensor
    constant: float = 0.0

    def scaled(self, factor: float) -> "TrigonometricPolynomial":
        """`factor * p`."""
        return replace(self, amplitudes=factor * self.amplitudes, constant=factor * self.constant)

    def inverse_laplacian(self) -> "TrigonometricPolynomial":
        """The mean-free `phi` with `Laplace(phi) = p - c`, mode by mode."""
        symbol = -(TURN**2) * self.waves.square().sum(dim=1)
        return replace(self, amplitudes=self.amplitudes / symbol, constant=0.0)

    def minus(self, other: "TrigonometricPolynomial") -> "TrigonometricPolynomial":
        """`p - other`."""
        return TrigonometricPolynomial(
            torch.cat([self.waves, other.waves]),
            torch.cat([self.amplitudes, -other.amplitudes]),
            torch.cat([self.phases, other.phases]),
            self.constant - other.constant,
        )

    def integral_with(self, other: "TrigonometricPolynomial") -> float:
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
        return TURN * (x @ self.waves.to(x).T) + self.phases.to(x)

    def __call__(self, x: Tensor) -> Tensor:
        """`p(x)`, ``(N,)``."""
        return self.constant + self._angle(x).cos() @ self.amplitudes.to(x)

    def gradient(self, x: Tensor) -> Tensor:
        """`grad p(x)`, ``(N, d)``."""
        return (-TURN * self.amplitudes.to(x) * self._angle(x).sin()) @ self.waves.to(x)

    def hessian(self, x: Tensor) -> Tensor:
        """Second derivatives of `p`, ``(N, d, d)``."""
        curvatures = -(TURN**2) * self.amplitudes.to(x) * self._angle(x).cos()
        return torch.einsum("nj,ji,jk->nik", curvatures, self.waves.to(x), self.waves.to(x))


def random_polynomial(
    dim: int, interaction: int, count: int, generator: torch.Generator, peak: Tensor | None = None
) -> TrigonometricPolynomial:
    """A random mean-free polynomial whose absolute amplitudes sum to 1; with ``peak`` ``(d,)`` it attains 1 there."""
    waves = _random_waves(dim, interaction, count, generator)
    size = 0.5 + torch.rand(count, generator=generator, dtype=torch.float64)
    amplitudes = size / waves.square().sum(dim=1)
    if peak is None:
        phases = TURN * torch.rand(count, generator=generator, dtype=torch.float64)
    else:
        phases = -TURN * (waves @ peak)
    return TrigonometricPolynomial(waves, amplitudes / amplitudes.sum(), phases)


def _random_waves(dim: int, interaction: int, count: int, generator: torch.Generator) -> Tensor:
    """``count`` wave vectors, each with exactly `min(interaction, dim)` non-zero entries, that together use every
    coordinate; in one coordinate the frequencies are 1, 2, ..., otherwise each entry is +-1 or (one in four) +-2."""
    if dim == 1:
        return torch.arange(1, count + 1, dtype=torch.float64).unsqueeze(-1)
    order = min(interaction, dim)
    waves = torch.zeros(count, dim, dtype=torch.float64)
    for j in range(count):
        others = [i for i in torch.randperm(dim, generator=generator).tolist() if i != j % dim]
        signs = 2.0 * torch.randint(2, (order,), generator=generator).double() - 1.0
        doubled = 1.0 + (torch.rand(order, generator=generator) < 0.25).double()
        waves[j, [j % dim, *others[: order - 1]]] = signs * doubled
    return waves


class WavyMatrix:
    r"""`B_ik(x) = M_ik (1 + DEPTH cos 2 pi (x_c + phase))` with a coordinate `c` and a phase for each entry, or `B = M`.

    ``mean`` is `M` ``(d, m)``; ``phase`` ``(d, m)`` in turns; ``coordinate`` ``(d, m)``; without ``varies`` it is constant.
    All drawn by ``generator``.
    """

    def __init__(self, dim: int, control_dim: int, varies: bool, generator: torch.Generator) -> None:
        self.varies = varies
        mixed = torch.randn(dim, control_dim, generator=generator, dtype=torch.float64)
        self.mean = torch.eye(dim, control_dim, dtype=torch.float64) + MIX * mixed / dim**0.5
        self.phase = torch.rand(dim, control_dim, generator=generator, dtype=torch.float64)
        self.coordinate = torch.randint(dim, (dim, control_dim), generator=generator)

    def __call__(self, x: Tensor) -> Tensor:
        """`B(x)`, ``(N, d, m)``."""
        mean = self.mean.to(x)
        return mean * (1.0 + DEPTH * self._angle(x).cos()) if self.varies else mean.expand(len(x), -1, -1)

    def slopes(self, x: Tensor) -> Tensor:
        """The derivative of each entry along its coordinate, ``(N, d, m)``."""
        if not self.varies:
            return x.new_zeros(len(x), *self.mean.shape)
        return -2.0 * DEPTH * torch.pi * self.mean.to(x) * self._angle(x).sin()

    def directions(self, x: Tensor) -> Tensor:
        """1 at `[i, k, c]` for the coordinate `c` of entry `(i, k)`, else 0: ``(d, m, d)``."""
        return torch.nn.functional.one_hot(self.coordinate.to(x.device), len(self.mean)).to(x)

    def divergence(self, x: Tensor) -> Tensor:
        """Of each column, ``(N, m)``: entry `(i, k)` counts where it varies with coordinate `i`."""
        rows = torch.arange(len(self.mean), device=x.device).unsqueeze(-1)
        return (self.slopes(x) * (self.coordinate.to(x.device) == rows)).sum(dim=1)

    def _angle(self, x: Tensor) -> Tensor:
        return TURN * (x[:, self.coordinate.to(x.device)] + self.phase.to(x))
