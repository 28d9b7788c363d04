r"""Value and gradient of a perceptron by one sweep forward and one back, and the slopes of both in its weights, written out.

Autograd differentiates the sweep back once more, through a graph of a few hundred operations: a step of small networks is
mostly that. But for slopes `v` ``(N,)`` of a loss in the values and `g` ``(N, d)`` in the gradients, what is to be
differentiated is `sum v V + sum g . grad V`, with the derivative of `V` along `g` at each state: a sweep forward along `g`,
and one back for both at once.
"""

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ocp_torch.fields.activations import DERIVATIVES
from ocp_torch.maths.jets import Jet


class Layer(ABC):
    """One hidden layer during the sweeps of one batch, called in this order; rows are states."""

    @abstractmethod
    def forward(self, h: Tensor) -> Tensor:
        """What comes out."""

    @abstractmethod
    def back(self, slope: Tensor) -> Tensor:
        """The slopes of the field in what comes in, from those in what comes out."""

    @abstractmethod
    def along(self, moved: Tensor) -> Tensor:
        """The derivative along `g` of what comes out, from that of what comes in."""

    @abstractmethod
    def differentiated(self, adjoint: Tensor) -> list[Tensor]:
        """The slopes of `sum v V + sum g . grad V` in the layer's parameters, from those in what comes out."""

    @abstractmethod
    def inward(self) -> Tensor:
        """The same in what comes in."""


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

    def differentiated(self, adjoint: Tensor) -> list[Tensor]:
        self.adjoint = (adjoint * self.first).addcmul_(self.second() * self.moved, self.slope)
        weight = torch.addmm(self.adjoint.T @ self.came, self.pre.T, self.moved_in)
        return [weight, self.adjoint.sum(dim=0)]

    def inward(self) -> Tensor:
        return self.adjoint @ self.weight


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

    def differentiated(self, adjoint: Tensor) -> list[Tensor]:
        steep = (adjoint * self.factor).addcmul_(self.slope, self.moved_linear)
        bent = (self.second() * self.moved_gate).mul_(self.factor)
        self.of_gate = (steep * self.first).addcmul_(bent, self.slope)
        self.of_linear = (adjoint * self.opened).addcmul_(self.slope, self.moved_open)
        found = []
        for of, pre in ((self.of_gate, self.pre_gate), (self.of_linear, self.pre_linear)):
            found += [torch.addmm(of.T @ self.came, pre.T, self.moved_in), of.sum(dim=0)]
        return found

    def inward(self) -> Tensor:
        return torch.addmm(self.of_gate @ self.gate.weight, self.of_linear, self.linear.weight)


class ReverseSweep:
    """The sweeps of the perceptron ``network`` over the states ``x`` ``(N, d)``; first `jet`, then `differentiated`."""

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

    def differentiated(self, of_value: Tensor, of_gradient: Tensor) -> list[Tensor]:
        """The slopes in all parameters, in the network's order, of what has the slopes ``of_value`` ``(N,)`` and
        ``of_gradient`` ``(N, d)`` in the jet."""
        turned = self.embedding.angles(of_gradient)
        cosines, sines = self.embedded.chunk(2, dim=-1)
        moved = torch.cat([-sines * turned, cosines * turned], dim=-1)
        for layer in self.layers:
            moved = layer.along(moved)
        scaled = self.scale * of_value
        head = self.scale * moved.sum(dim=0) + scaled @ self.last
        adjoint = scaled.unsqueeze(-1) * self.head.weight
        found = [head.unsqueeze(0), scaled.sum().unsqueeze(0)]
        for layer in reversed(self.layers):
            found = layer.differentiated(adjoint) + found
            if layer is not self.layers[0]:  # the embedding has no weights
                adjoint = layer.inward()
        return found


class _Swept(torch.autograd.Function):
    """`ReverseSweep`, for autograd."""

    @staticmethod
    def forward(ctx: Any, network: Any, x: Tensor, *weights: Tensor) -> Any:
        ctx.sweep = ReverseSweep(network, x)
        ctx.save_for_backward(*weights)  # which tells where one was changed meanwhile
        return ctx.sweep.jet()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_value: Tensor, of_gradient: Tensor) -> Any:
        _ = ctx.saved_tensors
        return None, None, *ctx.sweep.differentiated(of_value, of_gradient)


def swept_jet(network: Any, x: Tensor) -> Jet:
    """The jet of the scalar perceptron ``network`` at the states ``x`` ``(N, d)``, which are data; it can be differentiated
    once, in the weights."""
    weights = list(network.parameters())
    if torch.is_grad_enabled() and any(w.requires_grad for w in weights):
        return Jet(*_Swept.apply(network, x, *weights))
    with torch.no_grad():
        return Jet(*ReverseSweep(network, x).jet())
