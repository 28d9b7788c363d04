"""The best multiple of a density `mu`: every bound from its residual holds for each, and is convex in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from ocp_torch.certificate.estimate import integral
from ocp_torch.maths.supremum import minimiser
from ocp_torch.problems.samples import Samples

# The interval in which the multiple is sought: from no mass at all to twice what was fitted.
MULTIPLES = (0.0, 2.0)


@dataclass(frozen=True)
class Terms:
    """What the bounds on one set of states are made of: `V`, `mu Q_u` and `r`, each ``(N,)``."""

    samples: Samples
    v: Tensor
    spent: Tensor
    r: Tensor

    def residual(self, scale: float) -> Tensor:
        """The residual of ``scale`` times `mu`."""
        return self.samples.mu0 - scale * (self.samples.mu0 - self.r)

    def lagrangian(self, scale: float, hi: float, lo: float) -> float:
        """`E[hi max(r, 0) + lo max(-r, 0) - mu Q_u]` of ``scale`` times `mu`: the bound of 2. without `E[V mu0]`."""
        return integral(self.samples, self.lagrangian_integrand(scale, hi, lo))

    def lagrangian_integrand(self, scale: float, hi: float, lo: float) -> torch.Tensor:
        """What `lagrangian` is the mean of, ``(N,)``."""
        r = self.residual(scale)
        return hi * r.clamp_min(0.0) + lo * (-r).clamp_min(0.0) - scale * self.spent

    def J(self, scale: float, C_V: float) -> float:
        """The bound of 4., without `E[V mu0]`."""
        return integral(self.samples, self.J_integrand(scale, C_V))

    def J_integrand(self, scale: float, C_V: float) -> torch.Tensor:
        """What `J` is the mean of, ``(N,)``."""
        r = self.residual(scale)
        return C_V * r.clamp_min(0.0) - self.v * r - scale * self.spent

    @staticmethod
    def join(terms: list[Terms]) -> Terms:
        """All states of ``terms`` in one."""
        columns = (torch.cat([getattr(t, name) for t in terms]) for name in ("v", "spent", "r"))
        return Terms(Samples.concatenate([t.samples for t in terms]), *columns)


def best_multiples(terms: list[Terms], bound: Callable[[Terms, float], float]) -> list[float]:
    """``bound`` of each of ``terms`` with the multiple of `mu` that makes it smallest on the other half of them."""
    halves = [Terms.join(terms[k::2]) for k in (0, 1)]
    scales = [minimiser(partial(bound, half), *MULTIPLES) for half in halves]
    return [bound(t, scales[1 - i % 2]) for i, t in enumerate(terms)]
