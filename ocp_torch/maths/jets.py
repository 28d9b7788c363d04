"""Jets: a field's value and derivatives at a batch of states; and the derivatives of vector fields.

A field is any callable `(N, d) -> (N,)` or `(N, d) -> (N, m)` whose rows do not depend on one another. Its derivatives take
one reverse pass for each output: forward mode would take one for each direction, and runs PyTorch's operators through Python,
at several times the cost. Everything here is differentiable again with respect to the field's parameters.

Noise adds `D : hess`, `D = sigma sigma^T / 2`, for columns of `sigma` ``(N, d, k)`` that are data: a reverse pass for each
column. A field that knows a shorter way has a method ``jet(x, sigma)`` of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from ocp_torch.compute.threads import CHUNK, parted, side_by_side, spread

Field = Callable[[Tensor], Tensor]

# Pieces from which on other processes take some: the way there and back takes as long as one to four pieces.
SHARED_FROM = 8


@dataclass(frozen=True)
class Jet:
    """A scalar field's ``value`` ``(N,)`` and ``gradient`` ``(N, d)`` at `N` states: tensors, arrays or Taylor models; and
    where there is noise its ``curvature`` `D : hess` ``(N,)``."""

    value: Any
    gradient: Any
    curvature: Any = None

    def map(self, function: Callable[[Any], Any]) -> "Jet":
        """``function`` of each part: for a choice of states, a multiple, a detached jet."""
        curvature = None if self.curvature is None else function(self.curvature)
        return Jet(function(self.value), function(self.gradient), curvature)

    @staticmethod
    def concatenate(jets: "list[Jet]") -> "Jet":
        """The jets of one field at several batches of states as one."""
        curvature = None if jets[0].curvature is None else torch.cat([j.curvature for j in jets])
        return Jet(torch.cat([j.value for j in jets]), torch.cat([j.gradient for j in jets]), curvature)


def jet(field: Field, x: Tensor, sigma: Tensor | None = None) -> Jet:
    """The jet of a scalar ``field`` at states ``(N, d)``, with its curvature along the noise ``sigma`` ``(N, d, k)`` there:
    by its own method ``jet`` if it has one, else by reverse passes."""
    own = getattr(field, "jet", None)
    return reverse_jet(field, x, sigma) if own is None else own(x) if sigma is None else own(x, sigma)


def reverse_jet(field: Field, x: Tensor, sigma: Tensor | None = None) -> Jet:
    """`jet` by reverse passes, one and one more for each column of ``sigma``."""
    again, at = torch.is_grad_enabled(), _differentiable(x)
    if at is None:
        return _transformed_jet(field, x, sigma)
    with torch.enable_grad():
        # A node of its own: where sigma depends on x too, it is not differentiated.
        at = at if sigma is None else at.view_as(at)
        value = field(at)
        if not value.requires_grad:
            return Jet(value, torch.zeros_like(x), None if sigma is None else torch.zeros_like(value))
        # The gradient of a sum, as rows do not depend on one another: to be handed one PyTorch would import SymPy.
        twice = again or sigma is not None
        gradient = torch.autograd.grad(value.sum(), at, create_graph=twice, materialize_grads=True)[0]
        curvature = None if sigma is None else _curvature(gradient, at, sigma, again)
    return Jet(value, gradient, curvature) if again else Jet(value, gradient, curvature).map(Tensor.detach)


def curvature(field: Field, x: Tensor, sigma: Tensor) -> Tensor:
    """`sigma sigma^T / 2 : hess` ``(N,)`` of a scalar ``field`` at states ``(N, d)``, for columns ``sigma`` ``(N, d, k)``: by
    its own method ``curvature`` if it has one."""
    own = getattr(field, "curvature", None)
    return reverse_jet(field, x, sigma).curvature if own is None else own(x, sigma)


def _curvature(gradient: Tensor, at: Tensor, sigma: Tensor, again: bool) -> Tensor:
    """`D : hess` ``(N,)`` of the field whose ``gradient`` at the states ``at`` has a graph."""
    if not gradient.requires_grad:
        return torch.zeros_like(gradient[:, 0])
    options: dict[str, Any] = {"create_graph": again, "retain_graph": True, "materialize_grads": True}
    bent = (torch.autograd.grad((gradient * s).sum(), at, **options)[0] * s for s in sigma.unbind(-1))
    return 0.5 * sum((b.sum(dim=-1) for b in bent), torch.zeros_like(gradient[:, 0]))


def _transformed_jet(field: Field, x: Tensor, sigma: Tensor | None) -> Jet:
    """`jet` inside a transform of `torch.func`, where only its own derivatives work, at a higher cost."""
    value, pullback = torch.func.vjp(field, x)[:2]
    gradient = pullback(torch.ones_like(value))[0]
    if sigma is None:
        return Jet(value, gradient)
    slope = lambda y: _transformed_jet(field, y, None).gradient
    bent = (torch.func.jvp(slope, (x,), (s,))[1] * s for s in sigma.unbind(-1))
    return Jet(value, gradient, 0.5 * sum((b.sum(dim=-1) for b in bent), torch.zeros_like(value)))


def _differentiable(x: Tensor) -> Tensor | None:
    """``x`` to differentiate by; `None` inside a transform of `torch.func`."""
    try:
        return x if x.requires_grad else x.detach().requires_grad_(True)
    except RuntimeError:
        return None


def is_data(x: Tensor) -> bool:
    """Whether nothing is differentiated with respect to ``x``, neither by a graph nor by a transform of `torch.func`."""
    return not (torch.is_grad_enabled() and x.requires_grad) and _differentiable(x) is not None


@torch.no_grad()
def chunked_jet(field: Field, x: Tensor, sigma: Tensor | None = None, chunk: int = CHUNK) -> Jet:
    """The jet of a scalar ``field`` at many states, without a graph; on all cores where it is a network of this package,
    known by its method ``jet``, which is a pure function."""
    sizes = parted(len(x), chunk)
    columns = [None] * len(sizes) if sigma is None else sigma.split(sizes)
    quiet = torch.no_grad()(lambda of: jet(field, *of))  # each thread decides for itself whether there are graphs
    pieces = list(zip(x.split(sizes), columns, strict=True))
    shared = spread if len(pieces) >= SHARED_FROM else side_by_side
    return Jet.concatenate(shared(quiet, pieces, isinstance(field, nn.Module) and hasattr(field, "jet")))


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


def column_divergences(columns: Tensor, at: Tensor) -> Tensor:
    """The divergence ``(N, m)`` of each of the ``columns`` ``(N, d, m)``, computed from the states ``at`` ``(N, d)``: by a
    reverse pass for each entry, or none where they do not vary and so are not in the graph."""
    total = at.new_zeros(len(at), columns.shape[-1])
    if not columns.requires_grad:
        return total
    for i, row in enumerate(columns.unbind(dim=-2)):
        slopes = [
            torch.autograd.grad(c.sum(), at, retain_graph=True, materialize_grads=True)[0][:, i] for c in row.unbind(-1)
        ]
        total += torch.stack(slopes, dim=-1)
    return total


def diffusion_divergences(noise: Callable[[Tensor], Any], x: Tensor) -> tuple[Tensor, Tensor]:
    """`div D` ``(N, d)``, with components `sum_j d_j D_ij`, and `div div D` ``(N,)``, of `D = sigma sigma^T / 2` for the
    field ``noise``, `sigma`: ``(N, d) -> (N, d, k)``."""

    def row_divergence(y: Tensor) -> Tensor:
        # The divergence of sigma_ik sigma_jk / 2 by the product rule: d k reverse passes, where D itself would take d^2.
        flat, jacobian = value_and_jacobian(lambda z: noise(z).flatten(1), y)
        sigma, slope = (
            flat.unflatten(1, (y.shape[1], -1)),
            jacobian.unflatten(0, (y.shape[1], -1)),
        )  # slope (i, k, N, j)
        along = torch.einsum("njk,iknj->ni", sigma, slope)
        return 0.5 * (along + torch.einsum("nik,jknj->ni", sigma, slope))

    div_D, jacobian = value_and_jacobian(row_divergence, x)
    return div_D, torch.einsum("ini->n", jacobian)
