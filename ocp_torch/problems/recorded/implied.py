"""What recorded samples imply: divergences of constant fields are 0, and noise that is 0 everywhere is none."""

from dataclasses import replace

import torch
from torch import Tensor

from ocp_torch.problems.samples import Samples

# Matrices that differ by less, relative to 1 + their largest entry, are the same.
CONSTANT = 1e-9


def same_everywhere(matrices: Tensor) -> bool:
    """Whether all of the ``matrices`` ``(N, ...)`` are the same, but for rounding."""
    first = matrices[:1]
    return float((matrices - first).abs().max()) <= CONSTANT * (1.0 + float(first.abs().max()))


def completed(samples: Samples) -> Samples:
    """``samples`` with missing divergences set to 0 where drift is 0, `B` constant or noise constant, and without noise that
    is 0 everywhere."""
    zero = torch.zeros_like(samples.f)
    if samples.div_a is None and not samples.a.any():
        samples = replace(samples, div_a=zero)
    if samples.div_B is None and same_everywhere(samples.B):
        samples = replace(samples, div_B=zero.unsqueeze(-1).expand(-1, samples.B.shape[-1]))
    if samples.noise is not None and not samples.noise.any():
        return replace(samples, noise=None, div_D=None, div_div_D=None)
    if samples.noise is not None and samples.div_D is None and same_everywhere(samples.noise):
        return replace(samples, div_D=torch.zeros_like(samples.x), div_div_D=zero)
    return samples
