r"""A network and its gradient over a batch of cells.

What is enclosed is the function that the float64 weights define in real arithmetic, with exact cosines and activations.
"""

from __future__ import annotations

from typing import TypeGuard

from torch import nn

from ocp_torch.certificate.proof.activation_model import activate
from ocp_torch.certificate.proof.activations import SERIES
from ocp_torch.certificate.proof.box import Box
from ocp_torch.certificate.proof.smooth_model import affine, embed, product
from ocp_torch.certificate.proof.taylor import TaylorModel
from ocp_torch.fields.mlp import Gated, PeriodicMLP


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
