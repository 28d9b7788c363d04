"""Jets of a network in training at the states of a large batch, on all cores."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ocp_torch.compute.threads import side_by_side
from ocp_torch.maths.jets import Field, Jet, jet

PIECE_STATES = 512  # of a batch that is differentiated on several cores
# States times columns of the noise from which on that pays: at 1,024 states three columns take two thirds of the time on two
# cores, two columns as long as on one.
PARALLEL_FROM = 3072


def batch_jet(field: Field, x: Tensor, sigma: Tensor | None = None) -> Jet:
    """`jet` at the states of a batch, which are data; in pieces on all cores where a network learns from many with noise."""
    many = sigma is not None and len(x) * sigma.shape[2] >= PARALLEL_FROM
    if not many or not isinstance(field, nn.Module) or not torch.is_grad_enabled() or x.requires_grad or not x.is_cpu:
        return jet(field, x, sigma)
    weights = [p for p in field.parameters() if p.requires_grad]
    if not weights:
        return jet(field, x, sigma)
    return Jet(*_Pieces.apply(field, x, sigma, *weights))


class _Pieces(torch.autograd.Function):
    """The pieces of `batch_jet`: each has a graph of its own, since autograd goes back through a graph on a single core."""

    @staticmethod
    def forward(ctx: Any, field: Field, x: Tensor, sigma: Tensor, *weights: Tensor) -> Any:
        def piece(of: tuple[Tensor, Tensor]) -> Jet:
            with torch.enable_grad():
                return jet(field, *of)

        ctx.weights = weights
        ctx.jets = side_by_side(piece, list(zip(x.split(PIECE_STATES), sigma.split(PIECE_STATES), strict=True)))
        found = Jet.concatenate(ctx.jets).map(Tensor.detach)
        return found.value, found.gradient, found.curvature

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> Any:
        def piece(of: tuple) -> tuple:
            j, *cotangents = of
            parts = (j.value, j.gradient, j.curvature)
            return torch.autograd.grad(parts, ctx.weights, cotangents, retain_graph=True, materialize_grads=True)

        found = side_by_side(piece, list(zip(ctx.jets, *(s.split(PIECE_STATES) for s in slopes), strict=True)))
        return None, None, None, *(torch.stack(parts).sum(dim=0) for parts in zip(*found, strict=True))
