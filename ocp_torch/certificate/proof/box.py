"""A batch of cells of the torus, and the models over it that all others are made of."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.proof.taylor import ROUNDING, Monomials, TaylorModel, monomials, upward


@dataclass(frozen=True)
class Box:
    """`N` cells with ``centre`` and half-widths ``half``, both ``(N, d)`` and dyadic, so that both are exact."""

    centre: Tensor
    half: Tensor
    degree: int

    @property
    def basis(self) -> Monomials:
        return monomials(self.centre.shape[1], self.degree)

    def __len__(self) -> int:
        return len(self.centre)

    def coordinates(self) -> TaylorModel:
        """The model of `x` itself, ``(N, d)``."""
        basis = self.basis
        coefficients = self.centre.new_zeros(len(basis.exponents), *self.centre.shape)
        coefficients[0] = self.centre
        for i in range(basis.dim):
            unit = tuple(int(n == i) for n in range(basis.dim))
            coefficients[basis.index[unit], :, i] = self.half[:, i]
        return TaylorModel(coefficients, torch.zeros_like(self.centre), basis)

    def constant(self, value: Tensor | float, radius: Tensor | float = 0.0) -> TaylorModel:
        """A model of a function known up to ``radius`` by ``value``, ``(N, ...)`` or one number for all cells."""
        value, radius = (torch.as_tensor(given, dtype=self.centre.dtype) for given in (value, radius))
        return TaylorModel.constant(value if value.dim() else value.expand(len(self)), radius, self.basis)

    def cosine(self, waves: Tensor, phases: Tensor) -> TaylorModel:
        """`cos(2 pi k_j . x + theta_j)` for integer ``waves`` `k` ``(J, d)`` and ``phases`` ``(J,)``: ``(N, J)``."""
        basis, degree = self.basis, self.degree
        # k . c is exact for dyadic c, and so is taking whole turns from it.
        angle = 2.0 * math.pi * (self.centre @ waves.T).remainder(1.0) + phases
        frequency = 2.0 * math.pi * self.half.unsqueeze(1) * waves
        turns = [(angle + 0.5 * math.pi * (k % 4)).cos() for k in range(min(degree + 1, 4))]
        coefficients = angle.new_empty(len(basis.exponents), *angle.shape)
        for k, alpha in enumerate(basis.exponents):
            scale = math.prod(math.factorial(e) for e in alpha)
            coefficients[k] = turns[sum(alpha) % 4] * (frequency ** angle.new_tensor(alpha)).prod(dim=-1) / scale
        reach = frequency.abs().sum(dim=-1)
        left_out = reach ** (degree + 1) / math.factorial(degree + 1)
        rounding = ROUNDING * (8.0 + angle.abs()) * reach.exp()
        return TaylorModel(coefficients, upward(left_out + rounding), basis)


def equal_cells(dim: int, side: int, degree: int) -> Box:
    """``side`` cells per coordinate that cover the torus; ``side`` is a power of two, so that centres are exact."""
    edges = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    centre = torch.cartesian_prod(*[edges] * dim).reshape(-1, dim)
    return Box(centre, torch.full_like(centre, 0.5 / side), degree)
