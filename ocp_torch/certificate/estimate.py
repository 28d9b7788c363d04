"""Numbers with their uncertainty: means over independent randomised point sets."""

import math
from dataclasses import dataclass
from functools import cache
from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import require_integer, require_number
from ocp_torch.maths.mixtures import Mixture
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.starts import evaluation_distribution

# How often an interval covers the truth where nobody asks for another level.
CONFIDENCE = 0.95


@cache
def t_factor(level: float, degrees: int) -> float:
    """The `t` with `P(|T| <= t) = level` for Student's `T` of so many ``degrees`` of freedom: how many standard errors lie
    on each side of a mean of ``degrees + 1`` replicates. Raises `InputError` unless ``level`` is in (0, 1) and ``degrees`` at
    least 1."""
    require_number("level", level, above=0.0, at_most=1.0 - 1e-9)
    require_integer("degrees", degrees, 1)
    from scipy.special import stdtrit  # takes a third of a second to import, and only certificates need it

    # The lower tail: near 1 a probability has few digits left.
    return -float(stdtrit(degrees, 0.5 * (1.0 - level)))


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error, and a bound on what averaging cannot remove (integration and truncation).

    ``replicates`` is how many independent ones the standard error comes from; 0 where there is no sampling error.
    """

    value: float
    se: float
    bias: float | None = None
    controller: str | None = None
    replicates: int = 0

    @classmethod
    def of(cls, replicates: list[float], bias: float | None = None, controller: str | None = None) -> "Estimate":
        """Mean and standard error of independent ``replicates``."""
        values = np.asarray(replicates, dtype=np.float64)
        se = float(values.std(ddof=1) / math.sqrt(len(values)))
        return cls(float(values.mean()), se, bias, controller, len(values))

    @property
    def finite(self) -> bool:
        return math.isfinite(self.value) and math.isfinite(self.se)

    @property
    def above(self) -> float:
        """The upper end of the interval at `CONFIDENCE`: what an upper side may claim."""
        return self.interval(CONFIDENCE)[1]

    @property
    def below(self) -> float:
        """The lower end of the interval at `CONFIDENCE`."""
        return self.interval(CONFIDENCE)[0]

    def half_width(self, level: float) -> float:
        """Half of the confidence interval at ``level``: Student's t times the standard error, and all of the bias."""
        factor = t_factor(level, self.replicates - 1) if self.replicates > 1 else 0.0
        return factor * self.se + (self.bias or 0.0)

    def interval(self, level: float) -> tuple[float, float]:
        """The two-sided confidence interval at ``level``, widened by the bias."""
        half = self.half_width(level)
        return self.value - half, self.value + half

    def to_dict(self, level: float) -> dict:
        """JSON form, with the interval at ``level``; fields that do not apply are left out."""
        extra = {k: v for k, v in (("bias", self.bias), ("controller", self.controller)) if v is not None}
        interval = {"half_width": self.half_width(level), "interval": list(self.interval(level))}
        return {"value": self.value, "se": self.se, **extra, **interval}


def known(estimate: Estimate | None) -> TypeGuard[Estimate]:
    """Whether there is a number."""
    return estimate is not None and estimate.finite


def known_of(estimates: dict[str, Estimate | None]) -> dict[str, Estimate]:
    """Those of ``estimates`` that are numbers."""
    return {name: estimate for name, estimate in estimates.items() if known(estimate)}


@torch.no_grad()
def replicated_samples(
    problem: Problem, count: int, replicates: int, seed: int, divergences: bool, distribution: Mixture | None = None
) -> list[Samples]:
    """``replicates`` independent scrambled Sobol sets of ``count`` states with the problem's data, in float64; weighted, with
    more states where `mu0` or `f` is large on a small set, or from ``distribution``."""
    distribution = evaluation_distribution(problem) if distribution is None else distribution
    sets = [distribution.draw(count, r, seed) for r in range(replicates)]
    return [Samples.of(problem, x, divergences=divergences, weight=weight) for x, weight in sets]


def integral(samples: Samples, integrand: Tensor) -> float:
    """The weighted mean of ``integrand`` as a number."""
    return float(samples.mean(integrand))
