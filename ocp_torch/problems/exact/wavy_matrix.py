"""A control matrix each entry of which varies with one coordinate, so that its divergence is short to write."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

# How far an entry goes up and down, relative to its mean: below 1, so that none changes its sign.
DEPTH = 0.3
# How far the random part of the mean goes from the identity, in standard deviations, before it is divided by sqrt(d): small
# enough that the columns stay apart.
MIX = 0.25


class WavyMatrix:
    r"""`B_ik(x) = M_ik (1 + DEPTH cos 2 pi (x_c + phase))` with a coordinate `c` and a phase for each entry, or `B = M`.

    ``mean`` is `M` ``(d, m)``; ``phase`` ``(d, m)`` in turns; ``coordinate`` ``(d, m)``; without ``varies`` it is constant.
    All drawn by ``generator``.
    """

    def __init__(self, dim: int, control_dim: int, varies: bool, generator: torch.Generator) -> None:
        form: dict[str, Any] = dict(generator=generator, dtype=torch.float64)
        self.varies = varies
        self.mean = torch.eye(dim, control_dim, dtype=torch.float64)
        self.mean += MIX * torch.randn(dim, control_dim, **form) / dim**0.5
        self.phase = torch.rand(dim, control_dim, **form)
        self.coordinate = torch.randint(dim, (dim, control_dim), generator=generator)

    def __call__(self, x: Tensor) -> Tensor:
        """`B(x)`, ``(N, d, m)``."""
        mean = self.mean.to(x)
        return mean * (1.0 + DEPTH * self._angle(x).cos()) if self.varies else mean.expand(len(x), -1, -1)

    def slopes(self, x: Tensor) -> Tensor:
        """The derivative of each entry along its coordinate, ``(N, d, m)``."""
        if not self.varies:
            return x.new_zeros(len(x), *self.mean.shape)
        return -2.0 * DEPTH * torch.pi * self.mean.to(x) * self._angle(x).sin()

    def curvatures(self, x: Tensor) -> Tensor:
        """The second derivative of each entry along its coordinate, ``(N, d, m)``."""
        if not self.varies:
            return x.new_zeros(len(x), *self.mean.shape)
        return -DEPTH * (2.0 * torch.pi) ** 2 * self.mean.to(x) * self._angle(x).cos()

    def directions(self, x: Tensor) -> Tensor:
        """1 at `[i, k, c]` for the coordinate `c` of entry `(i, k)`, else 0: ``(d, m, d)``."""
        return torch.nn.functional.one_hot(self.coordinate.to(x.device), len(self.mean)).to(x)

    def divergence(self, x: Tensor) -> Tensor:
        """Of each column, ``(N, m)``: entry `(i, k)` counts where it varies with coordinate `i`."""
        rows = torch.arange(len(self.mean), device=x.device).unsqueeze(-1)
        return (self.slopes(x) * (self.coordinate.to(x.device) == rows)).sum(dim=1)

    def square_divergences(self, x: Tensor) -> tuple[Tensor, Tensor]:
        r"""`div D` ``(N, d)`` and `div div D` ``(N,)`` of `D = B B^T / 2`, by the product rule."""
        B, slopes, along = self(x), self.slopes(x), self.directions(x)
        columns = self.divergence(x)
        turned = torch.einsum("nik,ikj->nijk", slopes, along)
        rows = 0.5 * (torch.einsum("nijk,njk->ni", turned, B) + torch.einsum("nik,nk->ni", B, columns))
        own = torch.einsum("iki->ik", along)
        bent = (self.curvatures(x) * own * B).sum(dim=(1, 2))
        return rows, bent + 0.5 * columns.square().sum(-1) + 0.5 * torch.einsum("nijk,njik->n", turned, turned)

    def _angle(self, x: Tensor) -> Tensor:
        return 2.0 * torch.pi * (x[:, self.coordinate.to(x.device)] + self.phase.to(x))
