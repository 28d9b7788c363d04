r"""Linear fields in a periodic Sobolev space: the paper's reproducing-kernel space up to truncation (section 4.3).

A translation-invariant kernel `K(x, y) = sum_w k_w cos(2 pi w . (x - y))` has the features `sqrt(k_0)` and, per pair of
frequencies `w, -w`, `sqrt(2 k_w) cos(2 pi w . x)` and `sqrt(2 k_w) sin(2 pi w . x)`. For `V = theta . features` the gradient
in `theta` of a function of `V` is its gradient in the space, and `|theta|` is the norm of `V` there.
"""

import math

import numpy as np
import torch
from torch import Tensor, nn

from ocp_torch.errors import InputError, require_choice, require_flag, require_integer, require_number
from ocp_torch.maths.jets import Jet

KERNELS = ("product", "isotropic")
# Pairs of frequencies at most: beyond, one batch of features would fill the memory.
MOST_FREQUENCIES = 2**14
# Pairs of frequencies at most where ``modes`` is `None`.
COMFORTABLE_FREQUENCIES = 256


def frequencies_within(dim: int, kernel: str, modes: int, most: int) -> np.ndarray | None:
    """One of each pair `w, -w` of non-zero frequencies whose weight is at least that of `modes`; `None` beyond ``most``.

    The frequencies of the largest weights are a hyperbolic cross, `prod_i max(1, |w_i|) <= modes`, for the product
    kernel and a ball, `|w| <= modes`, for the isotropic one.
    """
    found = np.zeros((1, 0), dtype=np.int64)
    for _ in range(dim):
        if kernel == "product":
            reach = modes // np.maximum(np.abs(found), 1).prod(axis=1)
        else:
            reach = np.sqrt(modes**2 - np.square(found).sum(axis=1)).astype(np.int64)
        counts = 2 * reach + 1
        if counts.sum() > 2 * most + 1:
            return None
        last = np.concatenate([np.arange(-r, r + 1) for r in reach])
        found = np.concatenate([np.repeat(found, counts, axis=0), last[:, None]], axis=1)
    leading = found[np.arange(len(found)), (found != 0).argmax(axis=1)]
    half = found[leading > 0]
    return half[np.lexsort((*half.T, np.square(half).sum(axis=1)))]


class SobolevFeatures(nn.Module):
    """The features of the space of ``regularity`` `s`, ``(N, d) -> (N, F)``, and their derivatives.

    The spectrum is `k_0 = 1` and `prod_i max(1, |w_i|)^{-2s}` (``kernel=product``, for `d = 1` and `s = 2` the paper's) or
    `|w|^{-2s}` (``isotropic``). ``modes`` is the largest frequency along an axis; `None` for as many as are comfortable.
    Raises `InputError` where gradients are not continuous functionals (`s > 3/2`, or `s > 1 + d/2`, is needed) and where
    there would be too many features.
    """

    frequencies: Tensor  # (K, d)

    def __init__(self, dim: int, regularity: float = 2.0, kernel: str = "product", modes: int | None = None) -> None:
        super().__init__()
        self.kernel = require_choice("model.kernel", kernel, KERNELS)
        self.regularity = require_number("model.regularity", regularity, at_most=64.0)
        needed = 1.5 if kernel == "product" else 1.0 + dim / 2.0
        if self.regularity <= needed:
            raise InputError(
                f"model.regularity is {self.regularity:g}, but must be above {needed:g} for kernel={kernel} in dimension "
                f"{dim}: below, V in the space need not have a gradient."
            )
        frequencies = self._chosen(dim, modes)
        # Whole numbers are exact in every precision.
        self.register_buffer("frequencies", torch.tensor(frequencies.astype(np.float32)), persistent=False)
        self.count = 1 + 2 * len(frequencies)

    def _chosen(self, dim: int, modes: int | None) -> np.ndarray:
        if modes is not None:
            modes = require_integer("model.modes", modes, 1, maximum=MOST_FREQUENCIES)
            frequencies = frequencies_within(dim, self.kernel, modes, MOST_FREQUENCIES)
            if frequencies is None:
                raise InputError(
                    f"model.modes is {modes}, but in dimension {dim} that takes more than {MOST_FREQUENCIES} frequencies; "
                    "choose fewer, or kernel=isotropic."
                )
            return frequencies
        low, high = 0, COMFORTABLE_FREQUENCIES + 1
        best = None
        while high - low > 1:
            middle = (low + high) // 2
            frequencies = frequencies_within(dim, self.kernel, middle, COMFORTABLE_FREQUENCIES)
            low, high, best = (middle, high, frequencies) if frequencies is not None else (low, middle, best)
        if best is None:
            raise InputError(
                f"model.modes is not given, and in dimension {dim} even one mode takes more than "
                f"{COMFORTABLE_FREQUENCIES} frequencies with kernel={self.kernel}; use model.name=mlp."
            )
        return best

    def _waves(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cosines and sines ``(N, K)``, and the amplitudes ``(K,)``."""
        angles = 2.0 * math.pi * ((x - x.floor()) @ self.frequencies.T)
        return angles.cos(), angles.sin(), self.amplitudes()

    def amplitudes(self) -> Tensor:
        """`sqrt(2 k_w)`, ``(K,)``."""
        if self.kernel == "product":
            return math.sqrt(2.0) * self.frequencies.abs().clamp_min(1.0).prod(dim=1) ** -self.regularity
        return math.sqrt(2.0) * self.frequencies.square().sum(dim=1) ** (-0.5 * self.regularity)

    def forward(self, x: Tensor) -> Tensor:
        cosines, sines, amplitudes = self._waves(x)
        return torch.cat([torch.ones_like(x[..., :1]), amplitudes * cosines, amplitudes * sines], dim=-1)

    def jets(self, x: Tensor, sigma: Tensor | None = None) -> Tensor:
        """The features and their `d` derivatives, ``(N, 1 + d, F)``; last, where there is noise ``sigma`` ``(N, d, k)``,
        their curvature `D : hess`, ``(N, 2 + d, F)``."""
        cosines, sines, amplitudes = self._waves(x)
        values = torch.cat([torch.ones_like(x[:, :1]), amplitudes * cosines, amplitudes * sines], dim=-1)
        turned = torch.stack([-amplitudes * sines, amplitudes * cosines], dim=1)  # (N, 2, K)
        slopes = 2.0 * math.pi * self.frequencies.T  # (d, K)
        moved = (slopes[:, None] * turned[:, None]).flatten(2)  # (N, d, 2 K)
        derivatives = torch.cat([torch.zeros_like(x).unsqueeze(-1), moved], dim=-1)
        parts = [values.unsqueeze(1), derivatives]
        if sigma is not None:
            bent = -0.5 * self._driven(sigma)
            parts.append(torch.cat([torch.zeros_like(bent[:, :1]), bent, bent], dim=-1).mul(values).unsqueeze(1))
        return torch.cat(parts, dim=1)

    def _driven(self, sigma: Tensor) -> Tensor:
        """`2 w . D w (2 pi)^2` of each frequency, ``(N, K)``."""
        return torch.einsum("wd,ndk->nwk", 2.0 * math.pi * self.frequencies, sigma).square().sum(dim=-1)


class SobolevField(nn.Module):
    """`x -> shift + scale * theta . features(x)`, ``(N, d) -> (N,)`` or, with ``outputs``, ``(N, outputs)``; starts at 0.

    A plain gradient step on `theta` is a gradient step in the space. ``scaled`` takes the problem's units for shift and
    scale; without it they are 0 and 1, as in the paper, whose step sizes mean something only then. ``centred`` changes
    nothing.
    """

    shift: Tensor
    scale: Tensor

    def __init__(
        self,
        dim: int,
        outputs: int | None = None,
        regularity: float = 2.0,
        kernel: str = "product",
        modes: int | None = None,
        scaled: bool = False,
        shift: float = 0.0,
        scale: float = 1.0,
        centred: bool = False,
    ) -> None:
        super().__init__()
        require_flag("model.scaled", scaled)
        self._make(SobolevFeatures(dim, regularity, kernel, modes), outputs, shift, scale, scaled)

    @classmethod
    def defaults(cls, dim: int, worst_state: bool = False, noisy: bool = False) -> dict:
        """No defaults: where ``modes`` is `None` the features choose."""
        return {}

    @classmethod
    def of(cls, features: SobolevFeatures, outputs: int | None) -> "SobolevField":
        """The zero field on ``features`` that are there already, in units of 1."""
        field = cls.__new__(cls)
        nn.Module.__init__(field)
        field._make(features, outputs, 0.0, 1.0, False)
        return field

    def _make(self, features: SobolevFeatures, outputs: int | None, shift: float, scale: float, scaled: bool) -> None:
        self.features, self.scalar = features, outputs is None
        shape = (self.features.count,) if outputs is None else (outputs, self.features.count)
        self.coefficients = nn.Parameter(torch.zeros(shape))
        self.register_buffer("shift", torch.tensor(float(shift) if scaled else 0.0))
        self.register_buffer("scale", torch.tensor(float(scale) if scaled else 1.0))

    def forward(self, x: Tensor) -> Tensor:
        return self.shift + self.scale * (nn.functional.linear(self.features(x), self.coefficients))

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """The jet of a scalar field in closed form, from one set of waves, for noise ``sigma`` ``(N, d, k)``."""
        cosines, sines, amplitudes = self.features._waves(x)
        constant, rest = self.coefficients[:1], self.coefficients[1:]
        of_cosine, of_sine = amplitudes * rest[: len(amplitudes)], amplitudes * rest[len(amplitudes) :]
        value = self.shift + self.scale * (constant + cosines @ of_cosine + sines @ of_sine)
        turned = cosines * of_sine - sines * of_cosine
        gradient = self.scale * 2.0 * math.pi * (turned @ self.features.frequencies)
        if sigma is None:
            return Jet(value, gradient)
        bent = self.features._driven(sigma) * (cosines * of_cosine + sines * of_sine)
        return Jet(value, gradient, -0.5 * self.scale * bent.sum(dim=-1))

    @property
    def norm(self) -> Tensor:
        """The norm of `theta . features` in the space, that is of the field without its units."""
        return self.coefficients.detach().norm()
