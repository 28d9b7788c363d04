r"""A field in the space, for `R` independent runs: by truncated features, or exactly by the kernel at all past states.

Both move along `sum_a c_a d_a Phi(x)` at one state `x` (`d_0 Phi = Phi`), whose coefficients a rule gives, and compute their
jets at one state. ``mark`` and ``restore`` go back to where a look-ahead began.
"""

from typing import Any

import numpy as np
import torch

from ocp_torch.fields.sobolev import SobolevFeatures, SobolevField
from ocp_torch.studies.kernel.bernoulli import BernoulliKernel
from ocp_torch.studies.kernel.rules import Datum


class FeatureExpansion:
    """`V = theta . features` with `F` parameters, however many the states: a step costs the same at every `n`. ``radius`` is
    that of the ball `V` is projected on, `None` for no projection."""

    def __init__(self, features: SobolevFeatures, runs: int, outputs: int, radius: float | None) -> None:
        self.features, self.radius = features, radius
        self.theta = np.zeros((runs, features.count, outputs))
        self.total, self.count = np.zeros_like(self.theta), 0

    def jet(self, datum: Datum) -> np.ndarray:
        """Value, gradient and with noise curvature at the datum's state, ``(R, 1 + d or 2 + d, o)``."""
        return np.matmul(datum.jets, self.theta)

    def move(self, step: np.ndarray, datum: Datum) -> None:
        """Add the element with coefficients ``step`` ``(R, 1 + d or 2 + d, o)`` at the datum's state, and project."""
        self.theta = self.theta + np.matmul(datum.jets.transpose(0, 2, 1), step)
        if self.radius is not None:
            norm = np.sqrt(np.square(self.theta).sum(axis=(1, 2), keepdims=True))
            self.theta *= np.minimum(1.0, self.radius / np.maximum(norm, 1e-300))

    def mark(self) -> np.ndarray:
        return self.theta

    def restore(self, mark: Any) -> None:
        self.theta = mark

    def visit(self) -> None:
        """Count the present iterate in the average."""
        self.total += self.theta
        self.count += 1

    @torch.no_grad()
    def field(self, run: int, scalar: bool) -> SobolevField:
        """The averaged iterate of one run as a float64 network in units of 1; ``(N,)`` if ``scalar``."""
        theta = self.total[run] / max(self.count, 1)
        field = SobolevField.of(self.features, None if scalar else theta.shape[1]).double()
        field.coefficients.copy_(torch.from_numpy(theta[:, 0] if scalar else theta.T))
        return field.requires_grad_(False)


class KernelExpansion:
    """`V = sum_k alpha_k Phi(x_k) + sum_i beta_ki d_i Phi(x_k)` (Propositions 5, 7 and 10): a step costs `O(n)`.

    With noise `+ sum_k gamma_k D(x_k):hess Phi(x_k)`, as each past state keeps its diffusion: `n (d + 2)` parameters
    instead of `n (d + 1)` (the remark in section 4.3). Holds ``capacity`` states at most. The norm is kept up to date by
    the reproducing property.
    """

    def __init__(
        self,
        kernel: BernoulliKernel,
        dim: int,
        noisy: bool,
        capacity: int,
        runs: int,
        outputs: int,
        radius: float | None,
    ) -> None:
        self.kernel, self.radius, self.known = kernel, radius, 0
        self.x = np.zeros((runs, capacity, dim))
        self.D = np.zeros((runs, capacity, dim, dim)) if noisy else None
        width = dim + 2 if noisy else dim + 1
        self.coefficients = np.zeros((runs, capacity, width, outputs))
        self.total, self.count = np.zeros_like(self.coefficients), 0
        self.squared_norm = np.zeros(runs)

    @property
    def parameters(self) -> int:
        """The number of parameters of each run and output: `n (d + 1)` after `n` states, with noise `n (d + 2)`."""
        return self.known * self.coefficients.shape[2]

    def jet(self, datum: Datum) -> np.ndarray:
        """Value, gradient and with noise curvature at the datum's state, ``(R, 1 + d or 2 + d, o)``."""
        D = _diffusion(datum)
        return self.at(datum.x[:, None], D=None if D is None else D[:, None])[:, 0]

    def at(self, x: np.ndarray, average: bool = False, D: Any = None) -> np.ndarray:
        """Jets ``(R, N, 1 + d, o)`` at states ``(R or 1, N, d)`` of the present, or of the averaged, iterate; with the
        diffusion ``D`` ``(R or 1, N, d, d)`` there their curvature, too, ``(R, N, 2 + d, o)``."""
        n = self.known
        coefficients = self.total[:, :n] / max(self.count, 1) if average else self.coefficients[:, :n]
        past = None if self.D is None else self.D[:, None, :n]
        here = None if D is None else D[:, :, None]
        blocks = self.kernel.jets(self.x[:, None, :n], x[:, :, None], past, here)  # (R, N, n, 1 + d, 1 + d)
        runs, states, _, width, shown = blocks.shape
        rows = blocks.reshape(runs, states, n * width, shown).swapaxes(-1, -2)
        return np.matmul(rows, coefficients.reshape(len(self.x), 1, n * width, self.coefficients.shape[-1]))

    def move(self, step: np.ndarray, datum: Datum) -> None:
        """Add the element with coefficients ``step`` ``(R, 1 + d or 2 + d, o)`` at the datum's state, and project."""
        D = _diffusion(datum)
        if self.radius is not None:
            gram = self.kernel.jets(datum.x, datum.x, D, D)
            own = np.einsum("rao,rab,rbo->r", step, gram, step)
            self.squared_norm = self.squared_norm + 2.0 * (self.jet(datum) * step).sum(axis=(1, 2)) + own
        self.x[:, self.known] = datum.x
        if self.D is not None:
            self.D[:, self.known] = D
        self.coefficients[:, self.known] = step
        self.known += 1
        if self.radius is not None:
            norm = np.sqrt(np.maximum(self.squared_norm, 1e-300))
            factor = np.minimum(1.0, self.radius / norm)
            self.coefficients[:, : self.known] *= factor[:, None, None, None]
            self.squared_norm = self.squared_norm * factor**2

    def mark(self) -> tuple[np.ndarray, np.ndarray]:
        return self.coefficients[:, : self.known].copy(), self.squared_norm

    def restore(self, mark: Any) -> None:
        """States added since then stay, with the coefficient 0: the average may hold them."""
        coefficients, self.squared_norm = mark
        kept = coefficients.shape[1]
        self.coefficients[:, :kept] = coefficients
        self.coefficients[:, kept : self.known] = 0.0

    def visit(self) -> None:
        """Count the present iterate in the average."""
        self.total[:, : self.known] += self.coefficients[:, : self.known]
        self.count += 1


def _diffusion(datum: Datum) -> np.ndarray | None:
    """`D = sigma sigma^T / 2` at the datum's state, ``(R, d, d)``; `None` without noise."""
    return None if datum.noise is None else 0.5 * datum.noise @ datum.noise.swapaxes(-1, -2)
