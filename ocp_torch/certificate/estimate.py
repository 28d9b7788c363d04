"""Numbers with their uncertainty: means over independent randomised point sets."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ocp_torch.problems.problem import Problem
from ocp_torch.samplers import evaluation_points
from ocp_torch.samples import Samples


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error, and a bound on what averaging cannot remove (integration and truncation)."""

    value: float
    se: float
    bias: float | None = None
    controller: str | None = None

    @classmethod
    def of(cls, replicates: list[float], bias: float | None = None, controller: str | None = None) -> Estimate:
        """Mean and standard error of independent ``replicates``."""
        values = np.asarray(replicates, dtype=np.float64)
        return cls(float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values))), bias, controller)

    @property
    def finite(self) -> bool:
        return math.isfinite(self.value) and math.isfinite(self.se)

    @property
    def above(self) -> float:
        """The value with its bias and two standard errors on top: what a simulated upper side may claim."""
        return self.value + (self.bias or 0.0) + 2.0 * self.se

    def to_dict(self) -> dict:
        """JSON form: fields that do not apply are left out."""
        extra = {k: v for k, v in (("bias", self.bias), ("controller", self.controller)) if v is not None}
        return {"value": self.value, "se": self.se, **extra}


@torch.no_grad()
def replicated_samples(problem: Problem, count: int, replicates: int, seed: int, divergences: bool) -> list[Samples]:
    """``replicates`` independent scrambled Sobol sets of ``count`` states with the problem's data, in float64."""
    sets = [evaluation_points(count, problem.dim, r, seed) for r in range(replicates)]
    return [Samples.of(problem, x, divergences=divergences) for x in sets]


def integral(samples: Samples, integrand: Tensor) -> float:
    """The weighted mean of ``integrand`` as a number."""
    return float(samples.mean(integrand))
