"""Functions without derivatives of their own, made differentiable for autograd by central differences."""

from collections.abc import Callable

import torch
from torch import Tensor

# Half the distance of the two states of a difference quotient, by the function's precision: near the cube root of its
# rounding, which balances the errors by rounding and by curvature.
STEPS = {torch.float64: 1e-5, torch.float32: 2e-3}
# Steps of second derivatives of fourth order, to which rounding does more: near the sixth root of it.
SECOND_STEPS = {torch.float64: 1e-3, torch.float32: 2e-2}


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


def spread_divergences(
    noise: Callable[[Tensor], Tensor], x: Tensor, here: Tensor, step: float
) -> tuple[Tensor, Tensor]:
    """`div D` ``(N, d)`` and `div div D` ``(N,)`` of `D = sigma sigma^T / 2` by central differences of ``noise``, `sigma`:
    ``(N, d) -> (N, d, k)``, which is ``here`` at the float64 states ``x``; all `2 d (d + 1)` shifted batches in one call.

    Steps of ``step`` and twice as much are extrapolated: what is left is of order 4. `d_i d_j D_ij` is made of second
    differences along `e_i + e_j`, `e_i` and `e_j`.
    """
    d = x.shape[1]
    axes = torch.eye(d, dtype=x.dtype)
    pairs = [(i, j) for i in range(d) for j in range(i)]
    ways = torch.cat([axes, *(axes[i : i + 1] + axes[j : j + 1] for i, j in pairs)])
    shifts = torch.cat([size * sign * step * ways for size in (1.0, 2.0) for sign in (1.0, -1.0)])
    square = lambda sigma: 0.5 * sigma @ sigma.mT
    around = square(noise((x + shifts.unsqueeze(1)).flatten(0, 1))).reshape(2, 2, len(ways), len(x), d, d)
    sizes = step * torch.tensor([1.0, 2.0], dtype=x.dtype).reshape(2, 1, 1, 1, 1)
    finer = lambda steps: (4.0 * steps[0] - steps[1]) / 3.0
    first = finer((around[:, 0] - around[:, 1]) / (2.0 * sizes))  # (ways, N, d, d): the derivative along each way
    second = finer((around[:, 0] + around[:, 1] - 2.0 * square(here)) / sizes**2)
    div_D = torch.einsum("jnij->ni", first[:d])
    div_div_D = torch.einsum("inii->n", second[:d])
    for (i, j), along in zip(pairs, second[d:], strict=True):
        div_div_D = div_div_D + (along - second[i] - second[j])[:, i, j]
    return div_D, div_div_D
