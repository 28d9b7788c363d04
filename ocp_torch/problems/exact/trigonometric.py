"""Trigonometric polynomials on the torus and matrices of waves, with the derivatives that manufactured problems need."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ocp_torch.problems.device_constants import DeviceConstants

TURN = 2.0 * math.pi
# Amplitude of an entry of a matrix, relative to its mean: below 1, so that no entry changes its sign.
DEPTH = 0.3
# Standard deviation of the random part of the mean matrix, times sqrt(d): small enough that the columns stay independent.
MIX = 0.25
# Cosines of a vector field taken at once, 2 MiB in float64: 32 MiB took 1.6 to 2.7 times as long.
MOST_COSINES = 2**18


@dataclass(frozen=True)
class TrigonometricPolynomial(DeviceConstants):
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
        return TURN * (x @ self._like(x, "waves", self.waves).T) + self._like(x, "phases", self.phases)

    def _value(self, x: Tensor, angle: Tensor) -> Tensor:
        return self.constant + angle.cos() @ self._like(x, "amplitudes", self.amplitudes)

    def _slope(self, x: Tensor, angle: Tensor) -> Tensor:
        slopes = -TURN * self._like(x, "amplitudes", self.amplitudes) * angle.sin()
        return slopes @ self._like(x, "waves", self.waves)

    def __call__(self, x: Tensor) -> Tensor:
        """`p(x)`, ``(N,)``."""
        return self._value(x, self._angle(x))

    def gradient(self, x: Tensor) -> Tensor:
        """`grad p(x)`, ``(N, d)``."""
        return self._slope(x, self._angle(x))

    def with_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`p(x)` and `grad p(x)`."""
        angle = self._angle(x)
        return self._value(x, angle), self._slope(x, angle)

    def hessian(self, x: Tensor) -> Tensor:
        """Second derivatives of `p`, ``(N, d, d)``."""
        curvatures = -(TURN**2) * self._like(x, "amplitudes", self.amplitudes) * self._angle(x).cos()
        waves = self._like(x, "waves", self.waves)
        return torch.einsum("nj,ji,jk->nik", curvatures, waves, waves)


class TrigonometricField(DeviceConstants):
    """A vector field whose ``components`` are polynomials of equally many terms."""

    def __init__(self, components: list[TrigonometricPolynomial]) -> None:
        self.components = components
        self._waves = torch.cat([p.waves for p in components])
        self._phases = torch.cat([p.phases for p in components])
        self._amplitudes = torch.stack([p.amplitudes for p in components])
        self._constants = torch.tensor([p.constant for p in components], dtype=torch.float64)

    def __call__(self, x: Tensor) -> Tensor:
        """All components, ``(N, len(components))``."""
        most = max(1, MOST_COSINES // max(1, len(self._phases)))
        return torch.cat([self._at(part) for part in x.split(most)])

    def _at(self, x: Tensor) -> Tensor:
        turns, phases = x @ self._like(x, "waves", self._waves).T, self._like(x, "phases", self._phases)
        cosines = (TURN * turns + phases).cos().unflatten(1, self._amplitudes.shape)
        amplitudes = self._like(x, "amplitudes", self._amplitudes)
        return self._like(x, "constants", self._constants) + torch.einsum("nij,ij->ni", cosines, amplitudes)


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


class WavyMatrix(DeviceConstants):
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
        mean = self._like(x, "mean", self.mean)
        return mean * (1.0 + DEPTH * self._angle(x).cos()) if self.varies else mean.expand(len(x), -1, -1)

    def slopes(self, x: Tensor) -> Tensor:
        """The derivative of each entry along its coordinate, ``(N, d, m)``."""
        if not self.varies:
            return x.new_zeros(len(x), *self.mean.shape)
        return -2.0 * DEPTH * torch.pi * self._like(x, "mean", self.mean) * self._angle(x).sin()

    def curvatures(self, x: Tensor) -> Tensor:
        """The second derivative of each entry along its coordinate, ``(N, d, m)``."""
        if not self.varies:
            return x.new_zeros(len(x), *self.mean.shape)
        return -DEPTH * (2.0 * torch.pi) ** 2 * self._like(x, "mean", self.mean) * self._angle(x).cos()

    def directions(self, x: Tensor) -> Tensor:
        """1 at `[i, k, c]` for the coordinate `c` of entry `(i, k)`, else 0: ``(d, m, d)``."""
        return (self._at(x).unsqueeze(-1) == torch.arange(len(self.mean), device=x.device)).to(x)

    def divergence(self, x: Tensor) -> Tensor:
        """The divergence of each column, ``(N, m)``: entry `(i, k)` counts where it varies with coordinate `i`."""
        rows = torch.arange(len(self.mean), device=x.device).unsqueeze(-1)
        return (self.slopes(x) * (self._at(x) == rows)).sum(dim=1)

    def square_divergences(self, x: Tensor) -> tuple[Tensor, Tensor]:
        r"""`div D` ``(N, d)`` and `div div D` ``(N,)`` of `D = B B^T / 2`, by the product rule."""
        B, slopes, along = self(x), self.slopes(x), self.directions(x)
        columns = self.divergence(x)
        turned = torch.einsum("nik,ikj->nijk", slopes, along)
        rows = 0.5 * (torch.einsum("nijk,njk->ni", turned, B) + torch.einsum("nik,nk->ni", B, columns))
        own = torch.einsum("iki->ik", along)
        bent = (self.curvatures(x) * own * B).sum(dim=(1, 2))
        return rows, bent + 0.5 * columns.square().sum(-1) + 0.5 * torch.einsum("nijk,njik->n", turned, turned)

    def _angle(self, x: Tensor) -> Tensor:
        at = x.index_select(1, self._at(x).flatten()).unflatten(1, self.coordinate.shape)
        return TURN * (at + self._like(x, "phase", self.phase))

    def _at(self, x: Tensor) -> Tensor:
        return self._like(x, "coordinate", self.coordinate)
