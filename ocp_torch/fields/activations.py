"""Activations of networks and their derivatives, in closed form."""

import math
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor, nn


class Tanh(nn.Module):
    """`tanh z`, as `2 s(2 z) - 1` with the logistic function `s`: PyTorch's own takes three times as long on a CPU, more than
    the matrix product before it. Off by two units in the last place of 1."""

    def forward(self, z: Tensor) -> Tensor:
        return 2.0 * torch.sigmoid(2.0 * z) - 1.0


# Smooth activations only: the gradient of a field is part of every loss.
ACTIVATIONS = {"gelu": nn.GELU, "silu": nn.SiLU, "tanh": Tanh, "softplus": nn.Softplus}

# Maps an argument to a smooth function's value and first three derivatives, all of its shape; the last two once called.
Later = Callable[[], Tensor]
Derivatives = Callable[[Tensor], tuple[Tensor, Tensor, Later, Later]]


def _tanh(z: Tensor) -> tuple[Tensor, Tensor, Later, Later]:
    s = 2.0 * torch.sigmoid(2.0 * z) - 1.0
    slope = 1.0 - s * s
    return s, slope, lambda: -2.0 * s * slope, lambda: slope * (4.0 - 6.0 * slope)


def _gelu(z: Tensor) -> tuple[Tensor, Tensor, Later, Later]:
    below, square = torch.special.ndtr(z), z * z
    # PyTorch's exp takes two to three times as long as its exp2 on a CPU, and more where it vanishes.
    density = torch.exp2((-0.5 / math.log(2.0)) * square - 0.5 * math.log2(2.0 * math.pi))
    third = lambda: (square - 4.0) * z * density
    return z * below, torch.addcmul(below, z, density), lambda: (2.0 - square) * density, third


def _silu(z: Tensor) -> tuple[Tensor, Tensor, Later, Later]:
    s = torch.sigmoid(z)
    value = z * s
    # Few operations, each of which reads a whole layer: value and first derivative take two thirds of what they took in nine.
    slope, tilt = cache(lambda: torch.addcmul(s, s, s, value=-1.0)), cache(lambda: torch.rsub(s, 1.0, alpha=2.0))
    second = lambda: slope() * (2.0 + z * tilt())
    third = lambda: slope() * (3.0 * tilt() + z * (1.0 - 6.0 * slope()))
    return value, torch.addcmul(s + value, value, s, value=-1.0), second, third


def _softplus(z: Tensor) -> tuple[Tensor, Tensor, Later, Later]:
    s = torch.sigmoid(z)
    slope = s * (1.0 - s)
    return nn.functional.softplus(z), s, lambda: slope, lambda: slope * (1.0 - 2.0 * s)


# Each activation with its derivatives.
DERIVATIVES: dict[type[nn.Module], Derivatives] = {
    Tanh: _tanh,
    nn.Tanh: _tanh,
    nn.GELU: _gelu,
    nn.SiLU: _silu,
    nn.Softplus: _softplus,
}
