r"""A network and its gradient over a batch of cells, layer by layer.

What is enclosed is the function that the float64 weights define in real arithmetic, with exact cosines and activations.
An activation is expanded about its input at the centre of each cell, and the rest is bounded by degree.
"""

from typing import TypeGuard

import torch
from torch import Tensor, nn

from ocp_torch.certificate.proof.activations import SERIES, horner
from ocp_torch.certificate.proof.box import Box
from ocp_torch.certificate.proof.smooth_model import SmoothModel, affine, embed, product
from ocp_torch.certificate.proof.taylor import ROUNDING, Monomials, TaylorModel, upward
from ocp_torch.fields.mlp import Gated, PeriodicMLP
from ocp_torch.maths.sums import summed


def is_known(network: object) -> TypeGuard[PeriodicMLP]:
    """Whether `network_model` encloses ``network``: the package's own scalar perceptron with activations in plain form."""
    return type(network) is PeriodicMLP and network.scalar and all(map(_known, network.body.modules()))


def _known(layer: nn.Module) -> bool:
    plain = getattr(layer, "approximate", "none") == "none" and getattr(layer, "beta", 1.0) == 1.0
    return plain and type(layer) in (nn.Sequential, nn.Linear, Gated, *SERIES)


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


def activate(model: SmoothModel, activation: nn.Module) -> SmoothModel:
    r"""`sigma(h)`, with `d sigma(h)/dt_i = sigma'(h) dh/dt_i`."""
    m, basis = model.basis.degree, model.basis
    sigma = SERIES[type(activation)](m + 2)
    z = model.P[0]
    s = sigma.series(z, m + 1)
    errors = [sigma.error(k) for k in range(m + 2)]
    sizes = [c.abs() + e for c, e in zip(s, errors, strict=True)]
    sizes[0] = sizes[0] + errors[0] * z.abs()
    levels, r0 = model.sizes()[1:], model.radii[0]
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
        own = model.slope_sizes(i)
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
