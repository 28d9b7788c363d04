"""What the exact truth of a problem satisfies to rounding, and grids that integrate it exactly."""

from __future__ import annotations

import torch

from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples

# Pure float64 arithmetic, with no approximation but rounding.
ROUNDING = dict(rtol=1e-9, atol=1e-9)


def exact_slack(problem, x):
    generator = Generator.of(problem, Samples.of(problem, x))
    return generator.hjb_slack(generator.jet(problem.exact_value))


def lattice(dim: int) -> torch.Tensor:
    """A full grid, on which sums of trigonometric polynomials of frequency below its side are integrals, exactly."""
    side = torch.arange({1: 64, 2: 32, 3: 20}[dim], dtype=torch.float64)
    return torch.cartesian_prod(*[side / len(side)] * dim).reshape(-1, dim)
