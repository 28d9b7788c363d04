r"""A network and its gradient over a batch of cells, layer by layer.

What is enclosed is the function that the float64 weights define in real arithmetic, with exact cosines and activations.
Affine layers act on the polynomials exactly, so that only the radii, of order `degree` in the size of the cell, meet `|W|`.
An activation is expanded about its input at the centre of each cell, and the rest is bounded by degree. All rounding is
part of the radii (see `ROUNDING`).
"""

import math
from typing import TypeGuard

import torch
from torch import Tensor, nn

from ocp_torch.certificate.proof.activations import SERIES, horner
from ocp_torch.certificate.proof.models import Box, SmoothModel
from ocp_torch.certificate.proof.taylor import ROUNDING, Monomials, TaylorModel, upward
from ocp_torch.fields.mlp import Gated, PeriodicMLP
from ocp_torch.maths.sums import summed

# Room in the rounding of a dot product of n terms: it is bounded as if it had so many more.
EXTRA_TERMS = 8


def is_known(network: object) -> TypeGuard[PeriodicMLP]:
    """Whether `network_model` encloses ``network``: the package's own scalar perceptron with activations in plain form."""
    plain = lambda layer: getattr(layer, "approximate", "none") == "none" and getattr(layer, "beta", 1.0) == 1.0
    known = lambda layer: plain(layer) and type(layer) in (nn.Sequential, nn.Linear, Gated, *SERIES)
    return type(network) is PeriodicMLP and network.scalar and all(map(known, network.body.modules()))


def network_model(network: PeriodicMLP, box: Box) -> tuple[TaylorModel, TaylorModel]:
    """`V` ``(N,)`` and `grad V` ``(N, d)`` over ``box``, for a scalar float64 `PeriodicMLP`."""
    model = embed(box, network.embedding.waves(box.centre.shape[1]))
    for layer in network.body:
        if isinstance(layer, nn.Linear):
            model = affine(model, layer)
        elif isinstance(layer, Gated):
            model = product(activate(affine(model, layer.gate), layer.activation), affine(model, layer.linear))
        else:
            model = activate(model, layer)
    value, gradient = affine(model, network.head).models(box.half)
    return value[..., 0] * network.scale + network.shift, gradient[..., 0, :] * network.scale


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


def affine(model: SmoothModel, layer: nn.Linear) -> SmoothModel:
    """`W h + b`; the rounding of a dot product of `n` terms is at most `gamma_n = n u / (1 - n u)`, in whatever order."""
    weight, bias, basis = layer.weight, layer.bias, model.basis
    gamma = 2.0 * (weight.shape[1] + EXTRA_TERMS) * 2.0**-53
    P = model.P @ weight.T
    P[0] += bias
    slopes = [summed(basis.sizes(model.slope(i))) for i in range(basis.dim)]
    rounded = gamma * torch.stack([summed(basis.sizes(model.P)), *slopes])
    radii = (model.radii + rounded) @ weight.abs().T
    radii[0] += ROUNDING * P[0].abs() + gamma * bias.abs()
    # The last factor makes up for the rounding of the radii's own dot products.
    return SmoothModel(P, upward(radii * (1.0 + gamma)), basis)


def product(left: SmoothModel, right: SmoothModel) -> SmoothModel:
    """`g h`, with `d(g h)/dt_i = h dg/dt_i + g dh/dt_i`."""
    basis, m = left.basis, left.basis.degree
    g, h = basis.sizes(left.P), basis.sizes(right.P)
    G, H, rg, rh = summed(g), summed(h), left.radii[0], right.radii[0]
    value = G * rh + H * rg + rg * rh + basis.left_out(g, h) + ROUNDING * G * H
    slopes = []
    for i in range(basis.dim):
        dg, dh, sg, sh = basis.sizes(left.slope(i)), basis.sizes(right.slope(i)), left.radii[1 + i], right.radii[1 + i]
        DG, DH = summed(dg), summed(dh)
        tail = summed(dg[a] * h[b] + g[b] * dh[a] for a in range(m) for b in range(m - a, m + 1))
        spread = sg * (H + rh) + DG * rh + sh * (G + rg) + DH * rg
        slopes.append(spread + tail + m * ROUNDING * (DG * H + G * DH))
    return SmoothModel(basis.product(left.P, right.P), upward(torch.stack([value, *slopes])), basis)


def activate(model: SmoothModel, activation: nn.Module) -> SmoothModel:
    r"""`sigma(h)`, with `d sigma(h)/dt_i = sigma'(h) dh/dt_i`."""
    m, basis = model.basis.degree, model.basis
    sigma = SERIES[type(activation)](m + 2)
    z = model.P[0]
    s = sigma.series(z, m + 1)
    errors = [sigma.error(k) for k in range(m + 2)]
    sizes = [c.abs() + e for c, e in zip(s, errors, strict=True)]
    sizes[0] = sizes[0] + errors[0] * z.abs()
    levels, r0 = basis.sizes(model.P)[1:], model.radii[0]
    reach = upward(summed(levels))
    wide = upward(reach + r0)
    # Suprema over the range of h: of |sigma'|, |sigma''| and |sigma^{(m+1)}| / (m+1)!.
    beyond = sigma.ceiling(m + 2)
    first = horner([k * sizes[k] for k in range(1, m + 2)], wide) + (m + 2) * beyond * wide ** (m + 1)
    second = horner([k * (k - 1) * sizes[k] for k in range(2, m + 2)], wide) + (m + 2) * (m + 1) * beyond * wide**m
    first, second = first.clamp_max(sigma.ceiling(1)), second.clamp_max(2.0 * sigma.ceiling(2))
    top = (sizes[m + 1] + (m + 2) * beyond * wide).clamp_max(sigma.ceiling(m + 1))
    P = _composed(model.P, s[: m + 1], basis)
    # sigma'(P) = sum_k (k+1) s_{k+1} p^k, its absolute values by degree, with all degrees >= m in the last entry.
    derivative = _majorant([(k + 1) * sizes[k + 1] for k in range(m)], levels, m)
    moved = second * r0 + (m + 1) * top * reach**m
    known = horner(sizes[: m + 1], reach)
    varying = known - sizes[0]
    wrong = reach * horner([torch.full_like(z, e) for e in errors[1 : m + 1]], reach)
    inexact = m * (ROUNDING * (varying + ROUNDING * known) + wrong)
    slopes, cut_total = [], torch.zeros_like(z)
    for i in range(basis.dim):
        own = basis.sizes(model.slope(i))
        total = summed(own)
        cut = summed([derivative[m] * total, *(derivative[a] * summed(own[m - a :]) for a in range(1, m))])
        cut_total = cut_total + cut
        slopes.append(moved * total + cut + first * model.radii[1 + i] + inexact)
    # Terms of degree j > m of sigma(P) have slopes that add up to j times as much.
    value = first * r0 + top * reach ** (m + 1) + cut_total / (m + 1) + ROUNDING * known
    value = value + errors[0] * (1.0 + z.abs()) + wrong
    return SmoothModel(P, upward(torch.stack([value, *slopes])), basis)


def _composed(P: Tensor, series: list[Tensor], basis: Monomials) -> Tensor:
    """`sum_k s_k (P - P_0)^k` up to the degree of the basis, by Horner's rule: each stage needs one degree more."""
    m, ends = basis.degree, basis.ends
    result = series[m].unsqueeze(0)
    for stage in range(1, m + 1):
        grown = P.new_zeros(ends[stage + 1], *P.shape[1:])
        for i, j, k in basis.products:
            if i < len(result) and j > 0 and k < len(grown):
                grown[k].addcmul_(result[i], P[j])
        grown[0] = series[m - stage]
        result = grown
    return result


def _majorant(coefficients: list[Tensor], levels: list[Tensor], m: int) -> list[Tensor]:
    """Of `sum_k c_k (sum_j levels_j tau^j)^k` with everything >= 0: degrees `0 ... m - 1`, then all the rest together."""
    total = summed(levels)
    result = [coefficients[-1]]  # by degree; the tail starts empty
    tail = torch.zeros_like(total)
    for c in reversed(coefficients[:-1]):
        grown: list = [c] + [0.0] * (m - 1)
        grown_tail = tail * total
        for a, left in enumerate(result):
            for j, right in enumerate(levels, start=1):
                if a + j < m:
                    grown[a + j] = grown[a + j] + left * right
                else:
                    grown_tail = grown_tail + left * right
        result, tail = grown, grown_tail
    return [*result, tail]
