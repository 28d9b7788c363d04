r"""A network and its gradient over a batch of cells: one polynomial for `h`, and radii for `h` and each `dh/dt_i`.

A `SmoothModel` promises `|h - P| <= r_0` and `|dh/dt_i - dP/dt_i| <= r_i` on each cell `c + half t`, `t` in `[-1, 1]^d`.
Affine layers act on `P` exactly, so only the radii, of order `degree` in the size of the cell, meet `|W|`; an activation
is expanded about its input at the centre, and what is cut off is bounded degree by degree with absolute values.

What is enclosed is the function the float64 weights define in real arithmetic, with exact cosines and activations; the
rounding of every step is part of the radii (see `ocp_torch.maths.taylor`).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor, nn

from ocp_torch.certificate.proof.activations import SERIES
from ocp_torch.fields.mlp import Gated, PeriodicMLP
from ocp_torch.maths.taylor import ROUNDING, Box, Monomials, TaylorModel, upward


@dataclass(frozen=True)
class SmoothModel:
    """``P`` ``(K, N, width)`` by the order of ``basis``; ``radii`` ``(1 + d, N, width)``: of `h`, then of each `dh/dt_i`."""

    P: Tensor
    radii: Tensor
    basis: Monomials

    def degree_sizes(self) -> list[Tensor]:
        """`sum_{|alpha| = j} |P_alpha|` for each degree `j`."""
        return [self.P[a:b].abs().sum(dim=0) for a, b in itertools.pairwise(self.basis.ends)]

    def slope_sizes(self, i: int) -> list[Tensor]:
        """The same for `dP/dt_i`, of degrees `0 ... degree - 1`."""
        ends, exponents = self.basis.ends, self.basis.exponents
        weights = self.P.new_tensor([a[i] for a in exponents])[:, None, None]
        return [(self.P[a:b].abs() * weights[a:b]).sum(dim=0) for a, b in itertools.pairwise(ends[1:])]

    def models(self, half: Tensor) -> tuple[TaylorModel, TaylorModel]:
        """`h` ``(N, width)`` and `grad_x h` ``(N, width, d)`` on cells of half-widths ``half``."""
        slopes = []
        for i in range(self.basis.dim):
            slope = torch.zeros_like(self.P)
            for k, l, e in self.basis.derivative(i):
                slope[l] = e * self.P[k]
            # A quotient by a power of two, and the factors e, change nothing but the last bit.
            h = half[:, i].unsqueeze(-1)
            slope = slope / h
            slopes.append(
                TaylorModel(slope, upward(self.radii[1 + i] / h + ROUNDING * slope.abs().sum(dim=0)), self.basis)
            )
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


def affine(model: SmoothModel, weight: Tensor, bias: Tensor) -> SmoothModel:
    """`W h + b`; the rounding of a dot product of `n` terms is at most `gamma_n = n u / (1 - n u)`, in whatever order."""
    gamma = 2.0 * (weight.shape[1] + 8) * 2.0**-53
    P = model.P @ weight.T
    P[0] += bias
    slopes = [sum(model.slope_sizes(i)) for i in range(model.basis.dim)]
    rounded = gamma * torch.stack([sum(model.degree_sizes()), *slopes])
    radii = (model.radii + rounded) @ weight.abs().T
    radii[0] += ROUNDING * P[0].abs() + gamma * bias.abs()
    # The last factor makes up for the rounding of the radii's own dot products.
    return SmoothModel(P, upward(radii * (1.0 + gamma)), model.basis)


def activate(model: SmoothModel, activation: nn.Module) -> SmoothModel:
    r"""`sigma(h)`, with `d sigma(h)/dt_i = sigma'(h) dh/dt_i`."""
    m, basis = model.basis.degree, model.basis
    sigma = SERIES[type(activation)](m + 2)
    z = model.P[0]
    s = sigma.series(z, m + 1)
    errors = [sigma.error(k) for k in range(m + 2)]
    sizes = [c.abs() + e for c, e in zip(s, errors, strict=True)]
    sizes[0] = sizes[0] + errors[0] * z.abs()
    levels, r0 = model.degree_sizes()[1:], model.radii[0]
    reach = upward(sum(levels))
    wide = upward(reach + r0)
    # Suprema over the range of h: of |sigma'|, |sigma''| and |sigma^{(m+1)}| / (m+1)!.
    beyond = sigma.ceiling(m + 2)
    first = _polynomial([k * sizes[k] for k in range(1, m + 2)], wide) + (m + 2) * beyond * wide ** (m + 1)
    second = _polynomial([k * (k - 1) * sizes[k] for k in range(2, m + 2)], wide) + (m + 2) * (m + 1) * beyond * wide**m
    first, second = first.clamp_max(sigma.ceiling(1)), second.clamp_max(2.0 * sigma.ceiling(2))
    top = (sizes[m + 1] + (m + 2) * beyond * wide).clamp_max(sigma.ceiling(m + 1))
    P = _composed(model.P, s[: m + 1], basis)
    # sigma'(P) = sum_k (k+1) s_{k+1} p^k, its absolute values by degree, with all degrees >= m in the last entry.
    derivative = _majorant([(k + 1) * sizes[k + 1] for k in range(m)], levels, m)
    moved = second * r0 + (m + 1) * top * reach**m
    known = _polynomial([*sizes[: m + 1]], reach)
    varying = known - sizes[0]
    wrong = reach * _polynomial([torch.full_like(z, e) for e in errors[1 : m + 1]], reach)
    slopes, cut_total = [], 0.0
    for i in range(basis.dim):
        own = model.slope_sizes(i)
        total = sum(own)
        cut = derivative[m] * total
        for a in range(1, m):
            cut = cut + derivative[a] * sum(own[m - a :])
        cut_total = cut_total + cut
        inexact = m * (ROUNDING * (varying + ROUNDING * known) + wrong)
        slopes.append(moved * total + cut + first * model.radii[1 + i] + inexact)
    # Terms of degree j > m of sigma(P) have slopes that add up to j times as much.
    value = first * r0 + top * reach ** (m + 1) + cut_total / (m + 1) + ROUNDING * known
    value = value + errors[0] * (1.0 + z.abs()) + wrong
    return SmoothModel(P, upward(torch.stack([value, *slopes])), basis)


def product(left: SmoothModel, right: SmoothModel) -> SmoothModel:
    """`g h`, with `d(g h)/dt_i = h dg/dt_i + g dh/dt_i`."""
    basis, m = left.basis, left.basis.degree
    P = torch.zeros_like(left.P)
    for i, j, k in basis.products:
        P[k].addcmul_(left.P[i], right.P[j])
    g, h = left.degree_sizes(), right.degree_sizes()
    G, H, rg, rh = sum(g), sum(h), left.radii[0], right.radii[0]
    cut = sum(g[a] * h[b] for a in range(1, m + 1) for b in range(m + 1 - a, m + 1))
    value = G * rh + H * rg + rg * rh + cut + ROUNDING * G * H
    slopes = []
    for i in range(basis.dim):
        dg, dh, sg, sh = left.slope_sizes(i), right.slope_sizes(i), left.radii[1 + i], right.radii[1 + i]
        DG, DH = sum(dg), sum(dh)
        tail = sum(dg[a] * h[b] + g[b] * dh[a] for a in range(m) for b in range(m - a, m + 1))
        spread = sg * (H + rh) + DG * rh + sh * (G + rg) + DH * rg
        slopes.append(spread + tail + m * ROUNDING * (DG * H + G * DH))
    return SmoothModel(P, upward(torch.stack([value, *slopes])), basis)


def _polynomial(coefficients: list[Tensor], at: Tensor) -> Tensor:
    return reduce(lambda total, c: total * at + c, reversed(coefficients))


def _composed(P: Tensor, series: list[Tensor], basis: Monomials) -> Tensor:
    """`sum_k s_k (P - P_0)^k` up to the degree of the basis, by Horner's rule: each stage needs one degree more."""
    m, ends = basis.degree, basis.ends
    degree_of = [sum(a) for a in basis.exponents]
    result = series[m].unsqueeze(0)
    for stage in range(1, m + 1):
        grown = P.new_zeros(ends[stage + 1], *P.shape[1:])
        for i, j, k in basis.products:
            if i < len(result) and j > 0 and degree_of[k] <= stage:
                grown[k].addcmul_(result[i], P[j])
        grown[0] = series[m - stage]
        result = grown
    return result


def _majorant(coefficients: list[Tensor], levels: list[Tensor], m: int) -> list[Tensor]:
    """Of `sum_k c_k (sum_j levels_j tau^j)^k` with everything >= 0: degrees `0 ... m - 1`, then all the rest together."""
    total = sum(levels)
    result = [coefficients[-1]]  # by degree; the tail starts empty
    tail = 0.0
    for c in reversed(coefficients[:-1]):
        grown: list = [c] + [0.0] * (m - 1)
        grown_tail = tail * total
        for a, left in enumerate(result):
            for j, right in enumerate(levels, start=1):
                if a + j < m:
                    grown[a + j] = grown[a + j] + left * right
                else:
                    grown_tail = grown_tail + left * right
        # Degrees that cannot occur yet stay out.
        result, tail = grown[: min(m, len(grown))], grown_tail
    result = result + [torch.zeros_like(total)] * (m - len(result))
    return [*result, tail + torch.zeros_like(total)]


def network_model(network: PeriodicMLP, box: Box) -> tuple[TaylorModel, TaylorModel]:
    """`V` ``(N,)`` and `grad V` ``(N, d)`` over ``box``, for a scalar float64 `PeriodicMLP`."""
    model = embed(box, network.embedding.waves(box.centre.shape[1]))
    for layer in network.body:
        if isinstance(layer, nn.Linear):
            model = affine(model, layer.weight, layer.bias)
        elif isinstance(layer, Gated):
            gate, linear = (
                affine(model, layer.gate.weight, layer.gate.bias),
                affine(model, layer.linear.weight, layer.linear.bias),
            )
            model = product(activate(gate, layer.activation), linear)
        else:
            model = activate(model, layer)
    value, gradient = affine(model, network.head.weight, network.head.bias).models(box.half)
    return value[..., 0] * network.scale + network.shift, gradient[..., 0, :] * network.scale
