"""A function that nobody can differentiate as one that autograd can: its derivatives are central differences."""

from collections.abc import Callable

import torch
from torch import Tensor

# Half the distance of the two states of a difference quotient, by what the function computes in: near the cube root of its
# rounding, which balances what rounding and what curvature cost.
STEPS = {torch.float64: 1e-5, torch.float32: 2e-3}


class Differenced(torch.autograd.Function):
    """``Differenced.apply(x, function, step, gradients)`` is ``function`` ``(N, d) -> (N, ...)`` at ``x``.

    Tangents and gradients are differences of half width ``step``, in double precision; without ``gradients`` these are 0.
    Batches of batches are flattened.
    """

    @staticmethod
    def forward(x: Tensor, function: Callable[[Tensor], Tensor], step: float, gradients: bool) -> Tensor:
        return function(x)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        x, *ctx.how = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def jvp(ctx, tangent: Tensor, *_) -> Tensor:
        (x,) = ctx.saved_tensors
        return _difference(x, tangent, *ctx.how)

    @staticmethod
    def backward(ctx, outward: Tensor):
        (x,) = ctx.saved_tensors
        if not ctx.how[-1]:
            return torch.zeros_like(x), None, None, None
        basis = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        slopes = [outward * _difference(x, e.expand_as(x), *ctx.how) for e in basis]
        return torch.stack([s.reshape(len(x), -1).sum(dim=-1) for s in slopes], dim=-1), None, None, None

    @staticmethod
    def vmap(info, in_dims, x: Tensor, *how):
        if in_dims[0] is None:
            return Differenced.apply(x, *how), None
        x = x.movedim(in_dims[0], 0)
        return Differenced.apply(x.flatten(0, 1), *how).unflatten(0, x.shape[:2]), 0


def _difference(x: Tensor, direction: Tensor, function: Callable, step: float, gradients: bool) -> Tensor:
    x64, along = x.double(), direction.double()
    ahead, behind = (Differenced.apply(x64 + s * step * along, function, step, gradients) for s in (1.0, -1.0))
    return ((ahead - behind) / (2.0 * step)).to(direction)
