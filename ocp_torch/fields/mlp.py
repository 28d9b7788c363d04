"""Smooth multilayer perceptrons on a periodic embedding."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from ocp_torch.errors import require_choice, require_flag, require_integer
from ocp_torch.fields.embedding import FourierEmbedding

# Smooth activations only: the gradient of a field is part of every loss.
ACTIVATIONS = {"gelu": nn.GELU, "silu": nn.SiLU, "tanh": nn.Tanh, "softplus": nn.Softplus}


class Gated(nn.Module):
    """A hidden layer of products, `act(A h) * (B h)`: what couples many coordinates is a product of many factors."""

    def __init__(self, inward: int, outward: int, activation: nn.Module) -> None:
        super().__init__()
        self.gate, self.linear, self.activation = nn.Linear(inward, outward), nn.Linear(inward, outward), activation

    def forward(self, h: Tensor) -> Tensor:
        return self.activation(self.gate(h)) * self.linear(h)


class PeriodicMLP(nn.Module):
    """`x -> shift + scale * net(embedding(x))`, ``(N, d) -> (N,)`` or, with ``outputs``, ``(N, outputs)``.

    ``shift`` and ``scale`` are constants in the units of what is represented, so that one learning rate suits costs of
    any size. With ``gated`` each hidden layer multiplies two halves (`Gated`). The last layer starts small: the field
    starts near the constant ``shift``.
    """

    def __init__(
        self,
        dim: int,
        outputs: int | None = None,
        modes: int = 3,
        width: int = 96,
        depth: int = 3,
        activation: str = "gelu",
        gated: bool = False,
        waves: int = 0,
        shift: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        super().__init__()
        width = require_integer("model.width", width, 1, maximum=2**14)
        depth = require_integer("model.depth", depth, 1, maximum=64)
        activate = ACTIVATIONS[require_choice("model.activation", activation, ACTIVATIONS)]
        self.embedding = FourierEmbedding(dim, modes, waves)
        sizes = [self.embedding.width] + [width] * depth
        require_flag("model.gated", gated)
        layers: list[nn.Module] = []
        for inward, outward in zip(sizes, sizes[1:], strict=False):
            layers += [Gated(inward, outward, activate())] if gated else [nn.Linear(inward, outward), activate()]
        self.body = nn.Sequential(*layers)
        for module in self.body.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_normal_(module.weight)
                nn.init.zeros_(module.bias)
        self.head = nn.Linear(width, 1 if outputs is None else outputs)
        nn.init.normal_(self.head.weight, std=0.1 / width**0.5)
        nn.init.zeros_(self.head.bias)
        self.scalar = outputs is None
        self.register_buffer("shift", torch.tensor(float(shift)))
        self.register_buffer("scale", torch.tensor(float(scale)))

    def forward(self, x: Tensor) -> Tensor:
        out = self.shift + self.scale * self.head(self.body(self.embedding(x)))
        return out.squeeze(-1) if self.scalar else out

    def features(self, x: Tensor) -> Tensor:
        """What the last layer combines, ``(N, width)``, in the units of the field: `shifted_by` adds multiples of them."""
        return self.scale * self.body(self.embedding(x))

    def shifted_by(self, weights: Tensor) -> PeriodicMLP:
        """A copy whose one output has ``weights`` ``(width,)`` times the features added."""
        other = copy.deepcopy(self)
        with torch.no_grad():
            other.head.weight += weights.to(other.head.weight)
        return other
