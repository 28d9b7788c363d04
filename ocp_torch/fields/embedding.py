"""Periodic embeddings of the torus."""

import math

import torch
from torch import Tensor, nn

from ocp_torch.errors import require_integer


class FourierEmbedding(nn.Module):
    """`x -> (cos 2 pi k . x, sin 2 pi k . x)`: ``(..., d) -> (..., 2 d modes + 2 waves)``.

    The wave vectors `k` are `1..modes` times each unit vector, then ``waves`` more that `mix` sets and the state dict
    keeps; until then they are 0. States are wrapped to `[0, 1)` first, so that states far from the unit cell lose no
    precision.
    """

    wave_numbers: Tensor
    mixed: Tensor | None

    def __init__(self, dim: int, modes: int, waves: int = 0) -> None:
        super().__init__()
        modes = require_integer("model.modes", modes, 1, maximum=1024)
        waves = require_integer("model.waves", waves, 0, maximum=4096)
        self.width = 2 * (dim * modes + waves)
        # Whole numbers are exact in every precision; multiples of pi would not survive a change of it.
        self.register_buffer("wave_numbers", torch.arange(1.0, modes + 1.0), persistent=False)
        self.register_buffer("mixed", torch.zeros(waves, dim) if waves else None)

    @property
    def free(self) -> list[int]:
        """The places of ``mixed`` that hold no wave vector yet."""
        return [] if self.mixed is None else (self.mixed == 0.0).all(dim=-1).nonzero().flatten().tolist()

    def mix(self, waves: Tensor) -> tuple[list[int], list[int]]:
        """Take the wave vectors ``waves`` ``(W, d)``, as many as there are free places. Returns the columns of the new
        features: the cosines, which were 1 until now, and the sines, which were 0."""
        places = self.free[: len(waves)]
        if self.mixed is not None:
            self.mixed[places] = waves[: len(places)].to(self.mixed)
            first = self.width // 2 - len(self.mixed)
            places = [first + i for i in places]
        return places, [self.width // 2 + i for i in places]

    def waves(self, dim: int) -> Tensor:
        """All wave vectors, ``(J, d)``, in the order of `forward`."""
        like = self.wave_numbers
        units = torch.eye(dim, dtype=like.dtype, device=like.device)
        single = (units.unsqueeze(1) * like[:, None]).flatten(0, 1)
        return single if self.mixed is None else torch.cat([single, self.mixed])

    def forward(self, x: Tensor) -> Tensor:
        angles = self.angles(x - x.floor())
        return torch.cat([angles.cos(), angles.sin()], dim=-1)

    def angles(self, x: Tensor) -> Tensor:
        """`2 pi k . x` for each wave vector, ``(..., d) -> (..., J)``."""
        turns = (x.unsqueeze(-1) * self.wave_numbers).flatten(-2)
        if self.mixed is not None:
            turns = torch.cat([turns, x @ self.mixed.T], dim=-1)
        return 2.0 * math.pi * turns

    def pulled_back(self, slopes: Tensor, dim: int) -> Tensor:
        """The transpose of `angles`, ``(N, J) -> (N, d)``."""
        single = slopes[:, : dim * len(self.wave_numbers)].unflatten(-1, (dim, -1)) @ self.wave_numbers
        if self.mixed is not None:
            single = torch.addmm(single, slopes[:, -len(self.mixed) :], self.mixed)
        return 2.0 * math.pi * single
