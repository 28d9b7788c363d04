r"""A layer's values and their gradient over a batch of cells: one polynomial for `h`, and radii for `h` and each `dh/dt_i`.

A `SmoothModel` promises `|h - P| <= r_0` and `|dh/dt_i - dP/dt_i| <= r_i` on each cell `c + half t`, `t` in `[-1, 1]^d`.
Affine layers act on `P` exactly, so that only the radii, of order `degree` in the size of the cell, meet `|W|`. All rounding
is part of the radii (see `ROUNDING`).
"""

import itertools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.proof.box import Box
from ocp_torch.certificate.proof.taylor import ROUNDING, Monomials, TaylorModel, upward
from ocp_torch.maths.sums import summed

# Room in the rounding of a dot product of n terms: it is bounded as if it had so many more.
EXTRA_TERMS = 8


@dataclass(frozen=True)
class SmoothModel:
    """``P`` ``(K, N, width)`` by the order of ``basis``; ``radii`` ``(1 + d, N, width)``: of `h`, then of each `dh/dt_i`."""

    P: Tensor
    radii: Tensor
    basis: Monomials

    def sizes(self) -> list[Tensor]:
        """`sum_{|alpha| = j} |P_alpha|` for each degree `j`."""
        return self.basis.sizes(self.P)

    def slope_sizes(self, i: int) -> list[Tensor]:
        """The same for `dP/dt_i`, of degrees `0 ... degree - 1`."""
        ends, exponents = self.basis.ends, self.basis.exponents
        weights = self.P.new_tensor([a[i] for a in exponents])[:, None, None]
        return [(self.P[a:b].abs() * weights[a:b]).sum(dim=0) for a, b in itertools.pairwise(ends[1:])]

    def models(self, half: Tensor) -> tuple[TaylorModel, TaylorModel]:
        """`h` ``(N, width)`` and `grad_x h` ``(N, width, d)`` on cells of half-widths ``half``."""
        slopes = []
        for i in range(self.basis.dim):
            slope, h = torch.zeros_like(self.P), half[:, i].unsqueeze(-1)
            for k, l, e in self.basis.derivative(i):
                slope[l] = e * self.P[k]
            # A quotient by a power of two, and the factors e, change nothing but the last bit.
            slope = slope / h
            radius = upward(self.radii[1 + i] / h + ROUNDING * slope.abs().sum(dim=0))
            slopes.append(TaylorModel(slope, radius, self.basis))
        return TaylorModel(self.P, self.radii[0], self.basis), TaylorModel.stack(slopes)


def embed(box: Box, waves: Tensor) -> SmoothModel:
    """`FourierEmbedding` with wave vectors ``waves`` ``(J, d)`` over ``box``: all cosines, then all sines."""
    m = box.degree
    phases = torch.zeros(len(waves), dtype=waves.dtype)
    # sin = cos of a quarter turn less; the rounding of the phase is below that of the angle, counted twice over.
    both = box.cosine(torch.cat([waves, waves]), torch.cat([phases, phases - 0.5 * math.pi]))
    reach = 2.0 * math.pi * box.half.unsqueeze(1) * waves.abs()  # (N, J, d)
    total = reach.sum(dim=-1, keepdim=True)
    left_out = total**m / math.factorial(m) + 16.0 * m * ROUNDING * total.exp()
    slope = upward(reach * left_out).permute(2, 0, 1).repeat(1, 1, 2)
    return SmoothModel(both.coefficients, torch.cat([both.radius.unsqueeze(0), slope]), box.basis)


def affine(model: SmoothModel, layer: torch.nn.Linear) -> SmoothModel:
    """`W h + b`; the rounding of a dot product of `n` terms is at most `gamma_n = n u / (1 - n u)`, in whatever order."""
    weight, bias = layer.weight, layer.bias
    gamma = 2.0 * (weight.shape[1] + EXTRA_TERMS) * 2.0**-53
    P = model.P @ weight.T
    P[0] += bias
    slopes = [summed(model.slope_sizes(i)) for i in range(model.basis.dim)]
    rounded = gamma * torch.stack([summed(model.sizes()), *slopes])
    radii = (model.radii + rounded) @ weight.abs().T
    radii[0] += ROUNDING * P[0].abs() + gamma * bias.abs()
    # The last factor makes up for the rounding of the radii's own dot products.
    return SmoothModel(P, upward(radii * (1.0 + gamma)), model.basis)


def product(left: SmoothModel, right: SmoothModel) -> SmoothModel:
    """`g h`, with `d(g h)/dt_i = h dg/dt_i + g dh/dt_i`."""
    basis, m = left.basis, left.basis.degree
    g, h = left.sizes(), right.sizes()
    G, H, rg, rh = summed(g), summed(h), left.radii[0], right.radii[0]
    value = G * rh + H * rg + rg * rh + basis.left_out(g, h) + ROUNDING * G * H
    slopes = []
    for i in range(basis.dim):
        dg, dh, sg, sh = left.slope_sizes(i), right.slope_sizes(i), left.radii[1 + i], right.radii[1 + i]
        DG, DH = summed(dg), summed(dh)
        tail = summed(dg[a] * h[b] + g[b] * dh[a] for a in range(m) for b in range(m - a, m + 1))
        spread = sg * (H + rh) + DG * rh + sh * (G + rg) + DH * rg
        slopes.append(spread + tail + m * ROUNDING * (DG * H + G * DH))
    return SmoothModel(basis.product(left.P, right.P), upward(torch.stack([value, *slopes])), basis)
