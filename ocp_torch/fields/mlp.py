"""Smooth multilayer perceptrons on a periodic embedding."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ocp_torch.errors import require_choice, require_integer
from ocp_torch.fields.embedding import FourierEmbedding

# Smooth activations only: the gradient of a field is part of every loss.
ACTIVATIONS = {"gelu": nn.GELU, "silu": nn.SiLU, "tanh": nn.Tanh, "softplus": nn.Softplus}


class PeriodicMLP(nn.Module):
    """`x -> shift + scale * net(embedding(x))`, ``(N, d) -> (N,)`` or, with ``outputs``, ``(N, outputs)``.

    ``shift`` and ``scale`` are constants in the units of what is represented, so that one learning rate suits costs of
    any size. The last layer starts small: the field starts near the constant ``shift``.
    """

    def __init__(
        self,
        dim: int,
        outputs: int | None = None,
        modes: int = 3,
        width: int = 96,
        depth: int = 3,
        activation: str = "gelu",
        shift: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        super().__init__()
        width, depth = require_integer("model.width", width, 1), require_integer("model.depth", depth, 1)
        activate = ACTIVATIONS[require_choice("model.activation", activation, ACTIVATIONS)]
        self.embedding = FourierEmbedding(dim, modes)
        sizes = [self.embedding.width] + [width] * depth
        layers: list[nn.Module] = []
        for i, (inward, outward) in enumerate(zip(sizes, sizes[1:], strict=False)):
            layers += [nn.Linear(inward, outward), activate()]
            nn.init.xavier_normal_(layers[2 * i].weight)
            nn.init.zeros_(layers[2 * i].bias)
        self.body = nn.Sequential(*layers)
        self.head = nn.Linear(width, 1 if outputs is None else outputs)
        nn.init.normal_(self.head.weight, std=0.1 / width**0.5)
        nn.init.zeros_(self.head.bias)
        self.scalar = outputs is None
        self.register_buffer("shift", torch.tensor(float(shift)))
        self.register_buffer("scale", torch.tensor(float(scale)))

    def forward(self, x: Tensor) -> Tensor:
        out = self.shift + self.scale * self.head(self.body(self.embedding(x)))
        return out.squeeze(-1) if self.scalar else out
