"""Plane waves `e^{2 pi i k . x}` by which a distribution, or a flux, on the torus is tested."""

import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator

MULTIPLES = (1, 2, 3, 4, 6, 8, 12)  # of the unit vector of each axis
MOST_AXES = 8  # the first ones, along which and along whose sums and differences there are waves
RANDOM_WAVES = 24  # vectors of random entries
LARGEST_ENTRY = 4  # of these


def plane_waves(dim: int) -> Tensor:
    """Whole vectors `k` ``(K, d)``: 0, some along the axes, some of two of them, some at random."""
    axes = torch.eye(dim, dtype=torch.float64)[:MOST_AXES]
    first, second = torch.triu_indices(len(axes), len(axes), 1)
    pairs = torch.cat([axes[first] + axes[second], axes[first] - axes[second]])
    draw = torch.randint(-LARGEST_ENTRY, LARGEST_ENTRY + 1, (RANDOM_WAVES, dim), generator=fixed_generator()).to(axes)
    return torch.cat([torch.zeros_like(draw[:1]), *(k * axes for k in MULTIPLES), pairs, draw]).unique(dim=0)
