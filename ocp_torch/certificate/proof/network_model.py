r"""A field and its derivatives over a batch of cells, layer by layer.

What is enclosed is the function that the float64 weights define in real arithmetic, with exact cosines and activations.
Affine layers act on the polynomials exactly, so that only the radii, of order `degree` in the size of the cell, meet `|W|`.
Second derivatives, which only noise asks for, are those of the same polynomials, with radii one order larger. All rounding
is part of the radii (see `ROUNDING`).
"""

import itertools
import math
from typing import TypeGuard

import torch
from torch import Tensor, nn

from ocp_torch.certificate.proof.activated import activate
from ocp_torch.certificate.proof.activations import SERIES
from ocp_torch.certificate.proof.models import Box
from ocp_torch.certificate.proof.smooth import SmoothModel, derivatives
from ocp_torch.certificate.proof.taylor import ROUNDING, TaylorModel, upward
from ocp_torch.fields.mlp import Gated, PeriodicMLP
from ocp_torch.fields.sobolev import SobolevFeatures, SobolevField
from ocp_torch.maths.jets import Jet
from ocp_torch.maths.sums import summed

# Head-room for the rounding of a dot product, which is bounded as if it had so many more terms.
EXTRA_TERMS = 8
Known = PeriodicMLP | SobolevField


def is_known(field: object) -> TypeGuard[Known]:
    """Whether `network_model` encloses ``field``: the package's own scalar Sobolev field, or its own scalar perceptron with
    activations in plain form."""
    if type(field) is SobolevField:
        return field.scalar and type(field.features) is SobolevFeatures
    plain = lambda layer: getattr(layer, "approximate", "none") == "none" and getattr(layer, "beta", 1.0) == 1.0
    known = lambda layer: plain(layer) and type(layer) in (nn.Sequential, nn.Linear, Gated, *SERIES)
    return type(field) is PeriodicMLP and field.scalar and all(map(known, field.body.modules()))


def network_model(field: Known, box: Box, noise: TaylorModel | None = None) -> Jet:
    """`V` ``(N,)``, `grad V` ``(N, d)`` and, for ``noise`` `sigma` ``(N, d, k)``, `D : hess V` ``(N,)`` over ``box``, for a
    scalar float64 field."""
    curved = noise is not None
    model = _waved(field, box, curved) if isinstance(field, SobolevField) else _layered(field, box, curved)
    value, gradient = model.models(box.half)
    V = Jet(value[..., 0] * field.scale + field.shift, gradient[..., 0, :] * field.scale)
    if noise is None:
        return V
    D = (noise[:, None] * noise[None]).sum() * 0.5
    return Jet(V.value, V.gradient, (D * model.hessian(box.half)[0]).sum().sum() * field.scale)


def _layered(network: PeriodicMLP, box: Box, curved: bool) -> SmoothModel:
    """The last layer of a perceptron, ``(N, 1)``."""
    model = embed(box, network.embedding.waves(box.centre.shape[1]), curved)
    for layer in network.body:
        if isinstance(layer, nn.Linear):
            model = affine(model, layer.weight, layer.bias)
        elif isinstance(layer, Gated):
            gate, linear = affine(model, layer.gate.weight, layer.gate.bias), layer.linear
            model = product(activate(gate, layer.activation), affine(model, linear.weight, linear.bias))
        else:
            model = activate(model, layer)
    return affine(model, network.head.weight, network.head.bias)


def _waved(field: SobolevField, box: Box, curved: bool) -> SmoothModel:
    """The features of a Sobolev field, combined, ``(N, 1)``: float64 amplitudes times coefficients are their weights."""
    weights = field.features.amplitudes().repeat(2) * field.coefficients[1:]
    return affine(embed(box, field.features.frequencies, curved), weights.unsqueeze(0), field.coefficients[:1])


def embed(box: Box, waves: Tensor, curved: bool = False) -> SmoothModel:
    """`FourierEmbedding` with wave vectors ``waves`` ``(J, d)`` over ``box``: all cosines, then all sines."""
    m = box.degree
    phases = torch.zeros(len(waves), dtype=waves.dtype)
    # sin = cos of a quarter turn less; the rounding of the phase is below that of the angle, counted twice over.
    both = box.cosine(torch.cat([waves, waves]), torch.cat([phases, phases - 0.5 * math.pi]))
    reach = 2.0 * math.pi * box.half.unsqueeze(1) * waves.abs()  # (N, J, d)
    total, radii = reach.sum(dim=-1), [both.radius]
    for along in derivatives(waves.shape[1], curved)[1:]:
        k = len(along)
        left_out = total ** (m + 1 - k) / math.factorial(m + 1 - k) + 16.0 * m**k * ROUNDING * total.exp()
        radii.append(upward(reach[..., list(along)].prod(dim=-1) * left_out).repeat(1, 2))
    return SmoothModel(both.coefficients, torch.stack(radii), box.basis)


def affine(model: SmoothModel, weight: Tensor, bias: Tensor) -> SmoothModel:
    """`W h + b`; the rounding of a dot product of `n` terms is at most `gamma_n = n u / (1 - n u)`, in whatever order."""
    gamma = 2.0 * (weight.shape[1] + EXTRA_TERMS) * 2.0**-53
    P = model.P @ weight.T
    P[0] += bias
    rounded = gamma * torch.stack([summed(model.sizes(*along)) for along in model.derivatives])
    radii = (model.radii + rounded) @ weight.abs().T
    radii[0] += ROUNDING * P[0].abs() + gamma * bias.abs()
    # The last factor makes up for the rounding of the radii's own dot products.
    return SmoothModel(P, upward(radii * (1.0 + gamma)), model.basis)


def product(left: SmoothModel, right: SmoothModel) -> SmoothModel:
    """`g h`, whose derivatives are sums of products of derivatives of `g` and of `h`."""
    basis, m, places = left.basis, left.basis.degree, left.derivatives
    own, its = ({at: of.sizes(*at) for at in places} for of in (left, right))
    radii = []
    for along in places:
        parts, start = [], m + 1 - len(along)
        for taken in itertools.product((True, False), repeat=len(along)):
            mine = tuple(i for i, here in zip(along, taken, strict=True) if here)
            rest = tuple(i for i, here in zip(along, taken, strict=True) if not here)
            g, h, rg, rh = own[mine], its[rest], left.radii[places.index(mine)], right.radii[places.index(rest)]
            G, H = summed(g), summed(h)
            tail = summed(g[a] * h[b] for a in range(m + 1) for b in range(start - a, m + 1) if b >= 0)
            # A derivative of a monomial of degree m is at most m times as large.
            rounded = m ** len(along) * ROUNDING * G * H
            parts.append(rg * (H + rh) + G * rh + tail + rounded)
        radii.append(summed(parts))
    return SmoothModel(basis.product(left.P, right.P), upward(torch.stack(radii)), basis)
