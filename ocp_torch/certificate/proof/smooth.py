"""A layer's values over cells as polynomials, with bounds of what their derivatives leave out."""

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.proof.taylor import ROUNDING, Monomials, TaylorModel, upward


def derivatives(dim: int, curved: bool) -> list[tuple[int, ...]]:
    """The derivatives that have radii: the value `()`, each slope `(i,)`, and if ``curved`` each `(i, j)` with `i <= j`."""
    return [a for k in range(2 + curved) for a in itertools.combinations_with_replacement(range(dim), k)]


@dataclass(frozen=True)
class SmoothModel:
    """A layer's values `h` and their derivatives: `|h - P| <= r_0` and `|dh/dt_i - dP/dt_i| <= r_i` on each cell, and where
    second derivatives are carried likewise for those.

    ``P`` ``(K, N, width)`` by the order of ``basis``; ``radii`` ``(R, N, width)``, one for each of `derivatives`.
    """

    P: Tensor
    radii: Tensor
    basis: Monomials

    @property
    def derivatives(self) -> list[tuple[int, ...]]:
        """The `derivatives` that have radii, in the order of ``radii``."""
        return derivatives(self.basis.dim, len(self.radii) > 1 + self.basis.dim)

    def slope(self, *along: int) -> Tensor:
        """The coefficients of `dP/dt_i`, ``(K, N, width)``; for several coordinates ``along`` of repeated derivatives."""
        polynomial = self.P
        for i in along:
            slope = torch.zeros_like(polynomial)
            for alpha, coefficient in zip(self.basis.exponents, polynomial, strict=True):
                if alpha[i]:
                    lowered = tuple(e - (n == i) for n, e in enumerate(alpha))
                    slope[self.basis.index[lowered]] = alpha[i] * coefficient
            polynomial = slope
        return polynomial

    def sizes(self, *along: int) -> list[Tensor]:
        """The sums of the absolute coefficients of `slope` by degree, ``(N, width)`` each."""
        return self.basis.sizes(self.slope(*along))

    def _model(self, half: Tensor, *along: int) -> TaylorModel:
        """The derivative by `x`, ``(N, width)``, on cells of half-widths ``half``."""
        # A quotient by powers of two, and the factors of `slope`, change nothing but the last bit.
        unit = half[:, list(along)].prod(dim=-1, keepdim=True)
        slope, radius = self.slope(*along) / unit, self.radii[self.derivatives.index(tuple(sorted(along)))]
        return TaylorModel(slope, upward(radius / unit + ROUNDING * slope.abs().sum(dim=0)), self.basis)

    def models(self, half: Tensor) -> tuple[TaylorModel, TaylorModel]:
        """`h` ``(N, width)`` and `grad_x h` ``(N, width, d)`` on cells of half-widths ``half``."""
        slopes = [self._model(half, i) for i in range(self.basis.dim)]
        return TaylorModel(self.P, self.radii[0], self.basis), TaylorModel.stack(slopes)

    def hessian(self, half: Tensor) -> TaylorModel:
        """`hess_x h`, ``(N, width, d, d)``; needs the radii of second derivatives."""
        d = range(self.basis.dim)
        return TaylorModel.stack([TaylorModel.stack([self._model(half, i, j) for i in d]) for j in d])
