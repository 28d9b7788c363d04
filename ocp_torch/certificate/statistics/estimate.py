r"""Numbers with their uncertainty: means over independent randomised point sets, with plane waves as control variates.

Plane waves integrate to 0 over the torus, so what they explain of `g` may be taken off: `int g = E[g - sum_k c_k phi_k]`
for every choice of `c`, with `phi_k` cosines and sines of `2 pi k . x`, `k != 0`. The waves are those that stand out in `g`.
Each half of the sets is averaged with the coefficients that fit the other half best, so that the fit leaves no bias.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import TypeGuard

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import require_integer, require_number
from ocp_torch.fields.waves import WAVE_STATES, standardised, waves_of
from ocp_torch.maths.mixtures import Mixture
from ocp_torch.maths.sums import summed
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.starts import evaluation_distribution

CONFIDENCE = 0.95  # default level of intervals: how often they cover the truth
WAVES = 96  # in a fit
CHUNK = 8192  # states evaluated at once
FEWEST_STARTS = 16  # effective number of recorded starts, below which these tell no mean


@cache
def t_factor(level: float, degrees: int) -> float:
    """The `t` with `P(|T| <= t) = level` for Student's `T` of so many ``degrees`` of freedom, at least 1, and a ``level`` in
    (0, 1), else `InputError`: how many standard errors lie on each side of a mean of ``degrees + 1`` replicates."""
    require_number("level", level, above=0.0, at_most=1.0 - 1e-9)
    require_integer("degrees", degrees, 1)
    from scipy.special import stdtrit  # takes a third of a second to import, and only certificates need it

    # The lower tail: near 1 a probability has few digits left.
    return -float(stdtrit(degrees, 0.5 * (1.0 - level)))


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error, and a bound on what averaging cannot remove (integration and truncation).

    ``replicates`` is the number of independent means behind the standard error; 0 where there is no sampling error.
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
    """Whether there is an estimate, and it is finite."""
    return estimate is not None and estimate.finite


def known_of(estimates: dict[str, Estimate | None]) -> dict[str, Estimate]:
    """The ``estimates`` that are there and finite."""
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


def starting_level(samples: Samples, values: Tensor) -> float:
    """The mean of ``values`` ``(N,)`` by `mu0`, over its mass at the ``samples``; 0 where few of them have any."""
    shares = samples.weight * samples.mu0
    behind = float(shares.sum()) ** 2 / max(float(shares.square().sum()), 1e-300)
    return float((shares * values).sum() / shares.sum()) if behind >= FEWEST_STARTS else 0.0


def starting_mean(samples: Samples, values: Tensor, level: float) -> float:
    """`E[V mu0]` for ``values`` ``(N,)`` of `V`, from a ``level`` that other samples give: `mu0` has mass 1, so it is
    `c + E[(V - c) mu0]` for every `c`. With `c` near the answer it hardly matters how much of the mass of `mu0` these
    ``samples`` met, or whether `mu0` has a wrong factor too small for them to show."""
    return level + integral(samples, (values - level) * samples.mu0)


def integrals(states: list[Tensor], values: list[Tensor], weights: list[Tensor] | None = None) -> list[float]:
    """The mean of each of ``values`` ``(N,)`` over its set of ``states`` ``(N, d)``, less what plane waves explain where the
    states are uniform; else ``weights`` ``(N,)`` are one over their density, and no wave explains a narrow peak."""
    if weights is not None and any(bool((w != 1.0).any()) for w in weights):
        return [float((w * v).mean()) for w, v in zip(weights, values, strict=True)]
    plain = [float(v.mean()) for v in values]
    if len(states) < 2:
        return plain
    some = slice(0, max(1, WAVE_STATES // len(states)))
    functions = standardised(torch.cat([v[some] for v in values]))
    waves = waves_of(torch.cat([x[some] for x in states]), functions, WAVES).to(states[0])
    if not len(waves):
        return plain
    moments = [_moments(x, v, waves) for x, v in zip(states, values, strict=True)]
    fits = [_fit(moments[1 - half :: 2]) for half in (0, 1)]
    explained = [float(fits[i % 2] @ sums[1:] / sums[0]) for i, (sums, *_) in enumerate(moments)]
    return [p - e for p, e in zip(plain, explained, strict=True)]


def _moments(x: Tensor, v: Tensor, waves: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums of `(1, phi)`, of `phi phi^T` with the constant, and of `(1, phi) v` over one set."""
    count = 1 + 2 * len(waves)
    gram, right = v.new_zeros(count, count), v.new_zeros(count)
    for part, value in zip(x.split(CHUNK), v.split(CHUNK), strict=True):
        angles = 2.0 * math.pi * (part @ waves.T)
        phi = torch.cat([torch.ones_like(part[:, :1]), angles.cos(), angles.sin()], dim=1)
        gram, right = gram + phi.T @ phi, right + phi.T @ value
    return gram[0], gram, right


def _fit(moments: list[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    """Least-squares coefficients of the waves, beside a constant."""
    gram, right = summed(g for _, g, _ in moments), summed(r for *_, r in moments)
    ridge = 1e-10 * gram[0, 0] * torch.eye(len(gram), dtype=gram.dtype)
    return torch.linalg.solve(gram + ridge, right)[1:]
