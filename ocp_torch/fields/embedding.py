"""Periodic embeddings of the torus."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ocp_torch.errors import require_integer


class FourierEmbedding(nn.Module):
    """`x -> (cos 2 pi k x_i, sin 2 pi k x_i)` for `k = 1..modes` and each coordinate: ``(..., d) -> (..., 2 d modes)``.

    States are wrapped to `[0, 1)` first, so that states far from the unit cell lose no precision.
    """

    def __init__(self, dim: int, modes: int) -> None:
        super().__init__()
        self.modes = require_integer("model.modes", modes, 1, maximum=1024)
        self.width = 2 * dim * modes
        # Whole numbers are exact in every precision; multiples of pi would not survive a change of it.
        self.register_buffer("wave_numbers", torch.arange(1.0, modes + 1.0), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        angles = 2.0 * math.pi * ((x - x.floor()).unsqueeze(-1) * self.wave_numbers).flatten(-2)
        return torch.cat([angles.cos(), angles.sin()], dim=-1)
