r"""Value, gradient and `D : hess` of a perceptron in one sweep forward: exact, and cheaper than nested reverse passes.

Each layer is handed its input `h` ``(N, F)``, the derivatives `h_i` of it along `p` directions ``(p, N, F)`` and the
curvature `D : h_ij` ``(N, F)``. A linear layer maps them alike. An activation `s` maps them to `s(h)`, `s' h_i` and
`s' (D : h_ij) + s'' sum_ij D_ij h_i h_j`. The directions are the columns of the noise where there are fewer of them than
coordinates (one reverse pass then gives the gradient), or as many and these are diagonal or the same at all states; else the
coordinates.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ocp_torch.compute.decisions import decided
from ocp_torch.fields.activations import DERIVATIVES, Derivatives
from ocp_torch.fields.embedding import FourierEmbedding

# Largest condition number of noise by whose columns gradients are found: rounding grows by at most this factor.
LARGEST_CONDITION = 100.0


@dataclass(frozen=True)
class Along:
    """The directions derivatives are taken along: the columns of the noise, or else the coordinates."""

    columns: Tensor | None = None  # (N, d, p): directions that are not coordinates, and too few for the gradient
    scales: Tensor | None = None  # (N, d): the diagonal of noise that has no other entries
    frame: Tensor | None = None  # (d, d): lower triangular noise that is the same at all states
    inverse: Tensor | None = None  # (d, d): of ``frame``
    sigma: Tensor | None = None  # (N, d, k): the noise, where directions are not its columns

    @classmethod
    def of(cls, sigma: Tensor) -> "Along":
        """The cheapest directions for the noise ``sigma`` ``(N, d, k)``."""
        if sigma.shape[2] < sigma.shape[1]:
            return cls(columns=sigma)
        scales = sigma.diagonal(dim1=1, dim2=2)
        if sigma.shape[1] != sigma.shape[2]:
            return cls(sigma=sigma)
        plain = (sigma == torch.diag_embed(scales)).all() & scales.all()
        if decided(plain):
            return cls(scales=scales)
        if sigma.requires_grad:
            return cls(sigma=sigma)
        frame = sigma[0].tril()
        eye = torch.eye(len(frame), dtype=frame.dtype, device=frame.device)
        inverse = torch.linalg.solve_triangular(frame, eye, upper=False)
        even = (sigma == frame).all() & (frame.norm() * inverse.norm() < LARGEST_CONDITION)
        return cls(frame=frame, inverse=inverse) if decided(even) else cls(sigma=sigma)

    @property
    def enough(self) -> bool:
        """Whether the directions are columns of the noise along which derivatives determine gradients."""
        return self.scales is not None or self.frame is not None

    def derivatives(self, waves: Tensor, count: int) -> Tensor:
        """The derivatives ``(p, N, J)`` of linear functions with gradients ``waves`` ``(J, d)`` at ``count`` states `N`."""
        if self.columns is not None:
            return torch.einsum("jd,ndp->pnj", waves, self.columns)
        along = (waves if self.frame is None else waves @ self.frame).T.unsqueeze(1).expand(-1, count, -1)
        return along if self.scales is None else along * self.scales.T.unsqueeze(-1)

    def gradient(self, slopes: Tensor) -> Tensor:
        """The gradient ``(N, d)`` of what has derivatives ``slopes`` ``(d, N)``."""
        if self.inverse is not None:
            return slopes.T @ self.inverse
        return slopes.T if self.scales is None else slopes.T / self.scales

    def form(self, left: Tensor, right: Tensor) -> Tensor:
        """`sum_ij D_ij left_i right_j` ``(N, F)`` of derivatives ``(p, N, F)``."""
        if self.sigma is not None:
            driven = torch.einsum("ndk,dnf->knf", self.sigma, left)
            left, right = driven, driven if left is right else torch.einsum("ndk,dnf->knf", self.sigma, right)
        return 0.5 * (left * right).sum(dim=0)


@dataclass(frozen=True)
class Sweep:
    """What one layer hands on to the next."""

    value: Tensor  # (N, F)
    slopes: Tensor  # (p, N, F)
    curvature: Tensor  # (N, F)

    @classmethod
    def embedded(cls, embedding: FourierEmbedding, x: Tensor, along: Along) -> "Sweep":
        """The embedding and its derivatives at the states ``x`` ``(N, d)``."""
        value = embedding(x)
        cosines, sines = value.chunk(2, dim=-1)
        waves = 2.0 * math.pi * embedding.waves(x.shape[1]).to(x)  # (J, d)
        moved = along.derivatives(waves, len(x))
        bent = along.form(moved, moved).repeat(1, 2)
        return cls(value, torch.cat([-sines * moved, cosines * moved], dim=-1), -bent * value)

    def linear(self, layer: nn.Linear) -> "Sweep":
        """Through an affine layer: its bias moves the value alone."""
        return Sweep(layer(self.value), self.slopes @ layer.weight.T, self.curvature @ layer.weight.T)

    def activated(self, activation: nn.Module, along: Along) -> "Sweep":
        """Through a smooth function of each entry."""
        derivatives = DERIVATIVES[type(activation)]
        if along.enough:
            return Sweep(*Activated.apply(self.value, self.slopes, self.curvature, derivatives))
        value, first, second, _ = derivatives(self.value)
        bent = second() * along.form(self.slopes, self.slopes)
        return Sweep(value, first * self.slopes, first * self.curvature + bent)

    def times(self, other: "Sweep", along: Along) -> "Sweep":
        """The product of two layers, entry by entry."""
        crossed = 2.0 * along.form(self.slopes, other.slopes)
        return Sweep(
            self.value * other.value,
            self.slopes * other.value + self.value * other.slopes,
            self.curvature * other.value + self.value * other.curvature + crossed,
        )


class Activated(torch.autograd.Function):
    """`Sweep.activated` along columns of the noise, with a backward pass of its own: autograd's reads ``(p, N, F)`` numbers
    twice as often, and a step takes a quarter longer."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, slopes: Tensor, curvature: Tensor, derivatives: Derivatives) -> Any:
        value, first, bent, third = derivatives(z)
        second = bent()
        square = 0.5 * _contracted(slopes, slopes)
        if any(ctx.needs_input_grad):
            ctx.save_for_backward(slopes, curvature, square, first, second, third())
        return value, first * slopes, torch.addcmul(first * curvature, second, square)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_value: Tensor, of_slopes: Tensor, of_curvature: Tensor) -> Any:
        slopes, curvature, square, first, second, third = ctx.saved_tensors
        of_first = _contracted(of_slopes, slopes).addcmul_(of_curvature, curvature)
        of_z = (first * of_value).addcmul_(second, of_first).addcmul_(third * square, of_curvature)
        of_slopes = (first * of_slopes).addcmul_(second * of_curvature, slopes)
        return of_z, of_slopes, first * of_curvature, None


def _contracted(left: Tensor, right: Tensor) -> Tensor:
    """`sum_i left_i right_i` ``(N, F)`` of ``(p, N, F)``, without an array of the products."""
    total = left[0] * right[0]
    for one, other in zip(left[1:], right[1:], strict=True):
        total.addcmul_(one, other)
    return total
