r"""Value and gradient of a perceptron by one sweep forward and one back, and their derivatives in its weights, written out.

Autograd differentiates the sweep back once more, through a graph of a few hundred operations, which is most of a step of
small networks. But a loss with the derivatives ("slopes") `v` ``(N,)`` in the values and `g` ``(N, d)`` in the gradients has
in the weights the slopes of `S = sum v V + sum g . grad V`. Since `g . grad V` is the derivative of `V` along `g` at each
state, these take one sweep forward along `g`, and one back for both terms at once.
"""

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ocp_torch.fields.activations import DERIVATIVES
from ocp_torch.maths.jets import Jet

# States of a strip of the Gram matrix: what fits the cache.
STRIP_STATES = 128


class Layer(ABC):
    """One hidden layer during the sweeps over a batch; its methods are called in the order below. Rows are states."""

    @abstractmethod
    def forward(self, h: Tensor) -> Tensor:
        """The layer's output at its input ``h``."""

    @abstractmethod
    def back(self, slope: Tensor) -> Tensor:
        """The slopes of the field `V` in the layer's input, from its slopes ``slope`` in the output."""

    @abstractmethod
    def along(self, moved: Tensor) -> Tensor:
        """The derivative of the output along `g`, from ``moved``, that of the input."""

    @abstractmethod
    def turned(self, adjoint: Tensor) -> None:
        """Take ``adjoint``, the slopes of `S` in the output."""

    @abstractmethod
    def inward(self) -> Tensor:
        """The slopes of `S` in the input."""

    @property
    @abstractmethod
    def factors(self) -> list[tuple[Tensor, Tensor]]:
        """`(z, p)` for each affine map: the slopes of `S` in its matrix are `sum z h^T + p y^T`, where `h` is the input
        ``came`` and `y` is ``moved_in``, the input's derivative along `g`; those in its bias are `sum z`."""

    came: Tensor
    moved_in: Tensor

    @property
    def slopes(self) -> list[Tensor]:
        """The slopes of `S` in the layer's parameters."""
        found = []
        for z, p in self.factors:
            found += [torch.addmm(z.T @ self.came, p.T, self.moved_in), z.sum(dim=0)]
        return found

    def add_products(self, gram: Tensor, rows: slice, others: slice) -> None:
        """Add to ``gram`` the inner products of the states ``rows`` with the states ``others``: of the slopes in the layer's
        parameters that each state alone has, which are not formed."""
        came = self.came, self.moved_in
        products = [[one[rows] @ other[others].T for other in came] for one in came]
        products[0][0] += 1.0  # for the bias
        for pair in self.factors:
            for one, across in zip(pair, products, strict=True):
                for other, product in zip(pair, across, strict=True):
                    gram.addcmul_(one[rows] @ other[others].T, product)


class Dense(Layer):
    """`h -> s(W h + b)`."""

    def __init__(self, layer: nn.Linear, activation: nn.Module) -> None:
        self.weight, self.bias, self.derivatives = layer.weight, layer.bias, DERIVATIVES[type(activation)]

    def forward(self, h: Tensor) -> Tensor:
        self.came = h
        out, self.first, self.second, _ = self.derivatives(torch.addmm(self.bias, h, self.weight.T))
        return out

    def back(self, slope: Tensor) -> Tensor:
        self.slope = slope
        self.pre = slope * self.first
        return self.pre @ self.weight

    def along(self, moved: Tensor) -> Tensor:
        self.moved_in = moved
        self.moved = moved @ self.weight.T
        return self.first * self.moved

    def turned(self, adjoint: Tensor) -> None:
        self.adjoint = (adjoint * self.first).addcmul_(self.second() * self.moved, self.slope)

    def inward(self) -> Tensor:
        return self.adjoint @ self.weight

    @property
    def factors(self) -> list[tuple[Tensor, Tensor]]:
        return [(self.adjoint, self.pre)]


class Product(Layer):
    """`h -> s(A h + a) (B h + b)`."""

    def __init__(self, gate: nn.Linear, linear: nn.Linear, activation: nn.Module) -> None:
        self.gate, self.linear, self.derivatives = gate, linear, DERIVATIVES[type(activation)]

    def forward(self, h: Tensor) -> Tensor:
        self.came = h
        self.opened, self.first, self.second, _ = self.derivatives(torch.addmm(self.gate.bias, h, self.gate.weight.T))
        self.factor = torch.addmm(self.linear.bias, h, self.linear.weight.T)
        return self.opened * self.factor

    def back(self, slope: Tensor) -> Tensor:
        self.slope = slope
        self.pre_gate, self.pre_linear = slope * self.first * self.factor, slope * self.opened
        return torch.addmm(self.pre_gate @ self.gate.weight, self.pre_linear, self.linear.weight)

    def along(self, moved: Tensor) -> Tensor:
        self.moved_in = moved
        self.moved_gate, self.moved_linear = moved @ self.gate.weight.T, moved @ self.linear.weight.T
        self.moved_open = self.first * self.moved_gate
        return (self.moved_open * self.factor).addcmul_(self.opened, self.moved_linear)

    def turned(self, adjoint: Tensor) -> None:
        steep = (adjoint * self.factor).addcmul_(self.slope, self.moved_linear)
        bent = (self.second() * self.moved_gate).mul_(self.factor)
        self.of_gate = (steep * self.first).addcmul_(bent, self.slope)
        self.of_linear = (adjoint * self.opened).addcmul_(self.slope, self.moved_open)

    def inward(self) -> Tensor:
        return torch.addmm(self.of_gate @ self.gate.weight, self.of_linear, self.linear.weight)

    @property
    def factors(self) -> list[tuple[Tensor, Tensor]]:
        return [(self.of_gate, self.pre_gate), (self.of_linear, self.pre_linear)]


class ReverseSweep:
    """The sweeps of the perceptron ``network`` over the states ``x`` ``(N, d)``: call `jet`, then `turn`, then the rest."""

    def __init__(self, network: Any, x: Tensor) -> None:
        self.head, self.scale, self.shift = network.head, network.scale, network.shift
        self.layers: list[Layer] = network.layers()
        self.embedding, self.dim = network.embedding, x.shape[1]
        self.embedded = self.embedding(x)

    def jet(self) -> tuple[Tensor, Tensor]:
        """The values ``(N,)`` and the gradients ``(N, d)``."""
        h = self.embedded
        for layer in self.layers:
            h = layer.forward(h)
        self.last = h
        value = self.shift + self.scale * torch.addmm(self.head.bias, h, self.head.weight.T).squeeze(-1)
        slope = (self.scale * self.head.weight).expand_as(h)
        for layer in reversed(self.layers):
            slope = layer.back(slope)
        cosines, sines = self.embedded.chunk(2, dim=-1)
        of_cosines, of_sines = slope.chunk(2, dim=-1)
        return value, self.embedding.pulled_back(cosines * of_sines - sines * of_cosines, self.dim)

    def turn(self, of_value: Tensor, of_gradient: Tensor) -> None:
        """Take the slopes of a loss in the jet: ``of_value``, `v` ``(N,)``, and ``of_gradient``, `g` ``(N, d)``."""
        turned = self.embedding.angles(of_gradient)
        cosines, sines = self.embedded.chunk(2, dim=-1)
        moved = torch.cat([-sines * turned, cosines * turned], dim=-1)
        for layer in self.layers:
            moved = layer.along(moved)
        self.of_bias = self.scale * of_value
        self.of_head = (self.scale * moved).addcmul_(self.of_bias.unsqueeze(-1), self.last)
        adjoint = self.of_bias.unsqueeze(-1) * self.head.weight
        for layer in reversed(self.layers):
            layer.turned(adjoint)
            if layer is not self.layers[0]:  # the embedding has no weights
                adjoint = layer.inward()

    def slopes(self) -> list[Tensor]:
        """The slopes of the loss in all parameters, in the network's order."""
        head = [self.of_head.sum(dim=0, keepdim=True), self.of_bias.sum(dim=0, keepdim=True)]
        return [slope for layer in self.layers for slope in layer.slopes] + head

    def products(self) -> Tensor:
        """The Gram matrix ``(N, N)`` of the slopes that each state alone has in all parameters; valid below the diagonal and
        on it."""
        gram = self.of_head @ self.of_head.T + torch.outer(self.of_bias, self.of_bias)
        for first in range(0, len(gram), STRIP_STATES):  # in strips that fit the cache
            rows, others = slice(first, first + STRIP_STATES), slice(0, first + STRIP_STATES)
            for layer in self.layers:
                layer.add_products(gram[rows, others], rows, others)
        return gram


class _Swept(torch.autograd.Function):
    """`ReverseSweep`, for autograd."""

    @staticmethod
    def forward(ctx: Any, network: Any, x: Tensor, *weights: Tensor) -> Any:
        ctx.sweep = ReverseSweep(network, x)
        ctx.save_for_backward(*weights)  # so that autograd notices where one was changed meanwhile
        return ctx.sweep.jet()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_value: Tensor, of_gradient: Tensor) -> Any:
        _ = ctx.saved_tensors
        ctx.sweep.turn(of_value, of_gradient)
        return None, None, *ctx.sweep.slopes()


def swept_jet(network: Any, x: Tensor) -> Jet:
    """The jet of the scalar perceptron ``network`` at the states ``x`` ``(N, d)``, which are data; it can be differentiated
    once, in the weights."""
    if torch.is_grad_enabled():
        weights = list(network.parameters())
        if any(w.requires_grad for w in weights):
            return Jet(*_Swept.apply(network, x, *weights))
    with torch.no_grad():
        return Jet(*ReverseSweep(network, x).jet())
