"""Plane waves `e^{2 pi i k . x}` by which a distribution, or a flux, on the torus is tested."""

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator

# Waves along each of the first axes, of sums and differences of two of them, and in random directions.
ALONG, MOST_AXES, RANDOM, LARGEST = (1, 2, 3, 4, 6, 8, 12), 8, 24, 4


def plane_waves(dim: int) -> Tensor:
    """Whole vectors `k` ``(K, d)``: 0, some along the axes, some of two of them, some at random."""
    axes = torch.eye(dim, dtype=torch.float64)[:MOST_AXES]
    first, second = torch.triu_indices(len(axes), len(axes), 1)
    pairs = torch.cat([axes[first] + axes[second], axes[first] - axes[second]])
    draw = torch.randint(-LARGEST, LARGEST + 1, (RANDOM, dim), generator=fixed_generator()).to(axes)
    return torch.cat([torch.zeros_like(draw[:1]), *(k * axes for k in ALONG), pairs, draw]).unique(dim=0)
