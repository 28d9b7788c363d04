"""Derivatives of networks at a batch of states: gradients by one reverse pass, directional derivatives by forward mode.

A field is any callable `(N, d) -> (N,)` or `(N, d) -> (N, m)` whose rows do not depend on one another. Everything here
is differentiable again with respect to the field's parameters, and only networks are ever differentiated: the
divergences of the problem's `a` and `B` come in as data.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Field = Callable[[Tensor], Tensor]


def value_and_gradient(field: Field, x: Tensor) -> tuple[Tensor, Tensor]:
    """`V(x)` of shape ``(N,)`` and `grad V(x)` of shape ``(N, d)``."""
    explicit = getattr(field, "value_and_gradient", None)
    if explicit is not None:
        return explicit(x)
    value, pullback = torch.func.vjp(field, x)
    (gradient,) = pullback(torch.ones_like(value))
    return value, gradient


def directional_derivative(field: Field, x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """`field(x)` and its derivative along ``direction`` ``(N, d)``, both of the field's own shape."""
    return torch.func.jvp(field, (x,), (direction,))


def control_flux_divergence(control_density: Field, x: Tensor, B: Tensor, div_B: Tensor) -> tuple[Tensor, Tensor]:
    r"""`w` ``(N, m)`` and `div(B w) = (div B) . w + sum_k (d w_k along column k of B)` ``(N,)``: `m` forward tangents."""
    columns = B.permute(2, 0, 1)
    w, tangents = torch.func.vmap(
        lambda column: directional_derivative(control_density, x, column), out_dims=(None, 0)
    )(columns)
    along = torch.diagonal(tangents, dim1=0, dim2=2).sum(dim=-1)
    return w, (div_B * w).sum(dim=-1) + along


def divergence(vector_field: Field, x: Tensor) -> Tensor:
    """`div v(x)` ``(N,)`` of a field ``(N, d) -> (N, d)``, by `d` forward tangents."""
    basis = torch.eye(x.shape[1], dtype=x.dtype, device=x.device).unsqueeze(1).expand(-1, x.shape[0], -1)
    tangents = torch.func.vmap(lambda e: directional_derivative(vector_field, x, e)[1])(basis)
    return torch.diagonal(tangents, dim1=0, dim2=2).sum(dim=-1)
