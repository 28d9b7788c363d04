r"""Noise in physical units, and the noise on the torus that it makes, cut off at the seams like all motion."""

import torch
from torch import Tensor

from ocp_torch.maths import jets
from ocp_torch.problems.physical.chart import Chart
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced


class Disturbed(Problem):
    """A problem with a ``chart``, whose noise comes from `disturbance` or from constant columns given to `disturb`."""

    chart: Chart
    _columns: Tensor | None = None

    def disturbance(self, s: Tensor) -> Tensor | None:
        """`sigma`, ``(N, d, k)``, units of the coordinates per square root of the unit of time; `None`, not 0, for no noise.
        By default the columns given to `disturb` where there is a box."""
        return None if self._columns is None else self._like(s, "columns", self._columns).expand(len(s), -1, -1)

    def disturb(self, columns: Tensor) -> None:
        """Add noise ``columns`` ``(d, k)``, constant in the box and in the units of `disturbance`; for `__init__` alone."""
        columns = columns.double()[:, columns.any(dim=0)]
        if not self.chart.boxed:  # on the torus it is the same everywhere too
            self.add_noise(columns / self.chart.length.unsqueeze(-1))
        elif columns.shape[1]:
            self._columns = columns

    @property
    def _constant(self) -> bool:
        """Whether the disturbance is the same everywhere."""
        return not replaced(self, "disturbance", Disturbed)

    def _disturbance_at(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """Physical states and `disturbance` there; ``x`` and `None` where there is no disturbance."""
        quiet = self._constant and self._columns is None
        s = x if quiet else self.chart.from_torus(x)
        return s, None if quiet else self.disturbance(s)

    def noise(self, x: Tensor) -> Tensor | None:
        even, (s, sigma) = super().noise(x), self._disturbance_at(x)
        if sigma is None:
            return even
        rate = self.chart.cut(s).unsqueeze(-1) / self.chart.lengths(s)
        sigma = rate.unsqueeze(-1) * sigma
        return sigma if even is None else torch.cat([even, sigma], dim=-1)

    def noise_divergences(self, x: Tensor) -> tuple[Tensor, Tensor] | None:
        """`div D` ``(N, d)`` and `div div D` ``(N,)`` by the product rule, for `D_ij = chi^2 E_ij / (length_i length_j)` with
        `E = sigma sigma^T / 2` of `disturbance`."""
        zero, (s, sigma) = (torch.zeros_like(x), torch.zeros_like(x[:, 0])), self._disturbance_at(x)
        if sigma is None:
            return zero
        div_E, div_div_E = zero if self._constant else jets.diffusion_divergences(self.disturbance, s)
        square = jets.jet(lambda at: self.chart.cut(at).square(), s, sigma)
        along = 0.5 * (sigma @ torch.einsum("ndk,nd->nk", sigma, square.gradient).unsqueeze(-1)).squeeze(-1)
        div_div_D = square.curvature + 2.0 * (square.gradient * div_E).sum(dim=-1) + square.value * div_div_E
        return (along + square.value.unsqueeze(-1) * div_E) / self.chart.lengths(s), div_div_D
