"""Derivatives of networks at a batch of states, by one reverse pass for each output.

Forward mode would need one pass for each direction, but runs PyTorch's operators through Python, at several times the cost.

A field is any callable `(N, d) -> (N,)` or `(N, d) -> (N, m)` whose rows do not depend on one another. Everything here
is differentiable again with respect to the field's parameters, and only networks are ever differentiated: the
divergences of the problem's `a` and `B` come in as data.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Field = Callable[[Tensor], Tensor]

# States evaluated at once: what fits the cache is fastest.
CHUNK = 1024


def value_and_gradient(field: Field, x: Tensor) -> tuple[Tensor, Tensor]:
    """`V(x)` of shape ``(N,)`` and `grad V(x)` of shape ``(N, d)``."""
    explicit = getattr(field, "value_and_gradient", None)
    if explicit is not None:
        return explicit(x)
    again, at = torch.is_grad_enabled(), _differentiable(x)
    if at is None:
        value, pullback = torch.func.vjp(field, x)
        return value, pullback(torch.ones_like(value))[0]
    with torch.enable_grad():
        value = field(at)
        if not value.requires_grad:
            return value, torch.zeros_like(x)
        # The gradient of a sum, as rows do not depend on one another: to be handed one PyTorch would import SymPy.
        gradient = torch.autograd.grad(value.sum(), at, create_graph=again, materialize_grads=True)[0]
    return (value, gradient) if again else (value.detach(), gradient)


def _differentiable(x: Tensor) -> Tensor | None:
    """``x`` to differentiate by; `None` inside a transform of `torch.func`, where only its own derivatives work, at a higher
    cost."""
    try:
        return x if x.requires_grad else x.detach().requires_grad_(True)
    except RuntimeError:
        return None


@torch.no_grad()
def chunked_gradient(field: Field, x: Tensor, chunk: int = CHUNK) -> tuple[Tensor, Tensor]:
    """`V` and `grad V` at many states."""
    pairs = [value_and_gradient(field, part) for part in x.split(chunk)]
    return torch.cat([v for v, _ in pairs]), torch.cat([g for _, g in pairs])


def value_and_jacobian(field: Field, x: Tensor) -> tuple[Tensor, Tensor]:
    """`w(x)` ``(N, m)`` and its Jacobian ``(m, N, d)``."""
    again, at = torch.is_grad_enabled(), _differentiable(x)
    basis = lambda w: torch.eye(w.shape[1], dtype=w.dtype, device=w.device).unsqueeze(1).expand(-1, len(x), -1)
    if at is None:
        value, pullback = torch.func.vjp(field, x)
        return value, torch.func.vmap(pullback)(basis(value))[0]
    with torch.enable_grad():
        value = field(at)
        if not value.requires_grad:
            return value, x.new_zeros(value.shape[1], *x.shape)
        options = {"create_graph": again, "retain_graph": True, "materialize_grads": True}
        if value.shape[1] == 1:
            jacobian = torch.autograd.grad(value.sum(), at, **options)[0].unsqueeze(0)
        else:
            row = lambda direction: torch.autograd.grad(value, at, direction, **options)[0]
            jacobian = torch.func.vmap(row)(basis(value))
    return (value, jacobian) if again else (value.detach(), jacobian)


def directional_derivative(field: Field, x: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """`V(x)` and its derivative along ``direction`` ``(N, d)``, both ``(N,)``."""
    value, gradient = value_and_gradient(field, x)
    return value, (gradient * direction).sum(dim=-1)


def control_flux_divergence(control_density: Field, x: Tensor, B: Tensor, div_B: Tensor) -> tuple[Tensor, Tensor]:
    r"""`w` ``(N, m)`` and `div(B w) = (div B) . w + sum_k (d w_k along column k of B)` ``(N,)``."""
    w, jacobian = value_and_jacobian(control_density, x)
    return w, (div_B * w).sum(dim=-1) + torch.einsum("mnd,ndm->n", jacobian, B)


def divergence(vector_field: Field, x: Tensor) -> Tensor:
    """`div v(x)` ``(N,)`` of a field ``(N, d) -> (N, d)``."""
    _, jacobian = value_and_jacobian(vector_field, x)
    return torch.diagonal(jacobian, dim1=0, dim2=2).sum(dim=-1)
