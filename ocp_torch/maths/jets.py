"""Jets: a field's value and derivatives at a batch of states; and the derivatives of vector fields.

A field is any callable `(N, d) -> (N,)` or `(N, d) -> (N, m)` whose rows do not depend on one another. Its derivatives take
one reverse pass for each output: forward mode would take one for each direction, and runs PyTorch's operators through Python,
at several times the cost. Everything here is differentiable again with respect to the field's parameters.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

Field = Callable[[Tensor], Tensor]

# States evaluated at once: what fits the cache is fastest.
CHUNK = 1024


@dataclass(frozen=True)
class Jet:
    """A scalar field's ``value`` ``(N,)`` and ``gradient`` ``(N, d)`` at `N` states: tensors, arrays or Taylor models."""

    value: Any
    gradient: Any

    def map(self, function: Callable[[Any], Any]) -> "Jet":
        """``function`` of each part, for what acts on all alike: a choice of states, a multiple, the field as mere data."""
        return Jet(function(self.value), function(self.gradient))

    @staticmethod
    def concatenate(jets: "list[Jet]") -> "Jet":
        """The jets of one field at several batches of states as one."""
        return Jet(torch.cat([j.value for j in jets]), torch.cat([j.gradient for j in jets]))


def jet(field: Field, x: Tensor) -> Jet:
    """The jet of a scalar ``field`` at states ``(N, d)``: by its own method ``jet`` if it has one, else by a reverse pass."""
    own = getattr(field, "jet", None)
    if own is not None:
        return own(x)
    again, at = torch.is_grad_enabled(), _differentiable(x)
    if at is None:
        value, pullback = torch.func.vjp(field, x)[:2]
        return Jet(value, pullback(torch.ones_like(value))[0])
    with torch.enable_grad():
        value = field(at)
        if not value.requires_grad:
            return Jet(value, torch.zeros_like(x))
        # The gradient of a sum, as rows do not depend on one another: to be handed one PyTorch would import SymPy.
        gradient = torch.autograd.grad(value.sum(), at, create_graph=again, materialize_grads=True)[0]
    return Jet(value if again else value.detach(), gradient)


def _differentiable(x: Tensor) -> Tensor | None:
    """``x`` to differentiate by; `None` inside a transform of `torch.func`, where only its own derivatives work, at a higher
    cost."""
    try:
        return x if x.requires_grad else x.detach().requires_grad_(True)
    except RuntimeError:
        return None


@torch.no_grad()
def chunked_jet(field: Field, x: Tensor, chunk: int = CHUNK) -> Jet:
    """The jet of a scalar ``field`` at many states, without a graph."""
    return Jet.concatenate([jet(field, part) for part in x.split(chunk)])


def value_and_jacobian(field: Field, x: Tensor) -> tuple[Tensor, Tensor]:
    """`w(x)` ``(N, m)`` and its Jacobian ``(m, N, d)``."""
    again, at = torch.is_grad_enabled(), _differentiable(x)
    basis = lambda w: torch.eye(w.shape[1], dtype=w.dtype, device=w.device).unsqueeze(1).expand(-1, len(x), -1)
    if at is None:
        value, pullback = torch.func.vjp(field, x)[:2]
        return value, torch.func.vmap(pullback)(basis(value))[0]
    with torch.enable_grad():
        value = field(at)
        if not value.requires_grad:
            return value, x.new_zeros(value.shape[1], *x.shape)
        options: dict[str, Any] = {"create_graph": again, "retain_graph": True, "materialize_grads": True}
        if value.shape[1] == 1:
            jacobian = torch.autograd.grad(value.sum(), at, **options)[0].unsqueeze(0)
        else:
            row = lambda direction: torch.autograd.grad(value, at, direction, **options)[0]
            jacobian = torch.func.vmap(row)(basis(value))
    return (value, jacobian) if again else (value.detach(), jacobian)


def control_flux_divergence(control_density: Field, x: Tensor, B: Tensor, div_B: Tensor) -> tuple[Tensor, Tensor]:
    r"""`w` ``(N, m)`` and `div(B w) = (div B) . w + sum_k (d w_k along column k of B)` ``(N,)``."""
    w, jacobian = value_and_jacobian(control_density, x)
    return w, (div_B * w).sum(dim=-1) + torch.einsum("mnd,ndm->n", jacobian, B)


def divergence(vector_field: Field, x: Tensor) -> Tensor:
    """`div v(x)` ``(N,)`` of a field ``(N, d) -> (N, d)``."""
    _, jacobian = value_and_jacobian(vector_field, x)
    return torch.diagonal(jacobian, dim1=0, dim2=2).sum(dim=-1)
