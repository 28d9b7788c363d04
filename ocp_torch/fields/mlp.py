"""Smooth multilayer perceptrons on a periodic embedding."""

from math import comb, inf
from typing import Any

import torch
from torch import Tensor, nn

from ocp_torch.errors import require_choice, require_flag, require_integer
from ocp_torch.fields.activations import ACTIVATIONS
from ocp_torch.fields.centred import Centred
from ocp_torch.fields.embedding import FourierEmbedding
from ocp_torch.fields.forward_sweep import Along, Sweep
from ocp_torch.fields.reverse_sweep import Dense, Layer, Product, swept_jet
from ocp_torch.maths.jets import Jet, is_data, reverse_jet

# Network sizes by the largest number of coordinates they are for. Kinks need Fourier modes, affordable in few dimensions (a
# circle's gap is .023 % or less with 16, .034 % with 6); in many, gated layers learn coupled coordinates far faster.
SIZES = {
    1: dict(modes=16, waves=0, width=64, depth=2, gated=False),
    2: dict(modes=6, waves=16, width=96, depth=3, gated=False),
    4: dict(modes=3, waves=64, width=96, depth=3, gated=True),
    8: dict(modes=1, waves=64, width=128, depth=3, gated=True),
    inf: dict(modes=1, waves=128, width=128, depth=3, gated=True),
}
# Sizes in three and four coordinates where no Gauss-Newton steps are made, with noise or where the worst state counts: such
# steps do not converge on this network, but in 20 to 30 on the gated one above.
UNGATED_SIZES = dict(modes=3, waves=32, width=128, depth=3, gated=False)
# Where the worst state counts a network should have little curvature, for an error that is small everywhere and not only on
# average: no gates, and silu (six oscillators had a simulated gap of 1.20 %, with gelu 1.59 %).
WORST_STATE_OPTIONS = dict(gated=False, activation="silu")
# Waves where the worst state counts: in two coordinates the harmonics of kinks help (an arm's gap is .67 % with 64, 1.11 %
# with 16); in more they make spikes (a unicycle's is .77 and .66 %), and one for each pair of coordinates is enough.
WAVES_IN_TWO = 64
LEAST_WAVES = 16  # in more than two coordinates
WAVES_PER_COORDINATE = 4  # at least, in more than two coordinates
# A network fitted to values along trajectories: an acrobot's cost was 2.35 with gelu and 32 waves, 2.54 with silu and 16.
FITTED_ACTIVATION = "gelu"
FITTED_WAVES = 32  # at least
# In one dimension with noise, which turns a kink of the cost into one of the second derivative: on a circle F_M was .055 %
# below OPT with 6 modes, .017 % with 24 and the 2,000 steps that these take.
NOISY_MODES = 24
# States times directions of a forward sweep without a graph: more do not fit the cache (1,024 states in 64 coordinates take
# 1.0 s so, 1.8 s at once).
SWEEP_SIZE = 2048
LEAST_SWEEP_STATES = 32  # for any number of directions


class Gated(nn.Module):
    """A hidden layer of products, `act(A h) * (B h)`: what couples many coordinates is a product of many factors."""

    def __init__(self, inward: int, outward: int, activation: nn.Module) -> None:
        super().__init__()
        self.gate, self.linear, self.activation = nn.Linear(inward, outward), nn.Linear(inward, outward), activation

    def forward(self, h: Tensor) -> Tensor:
        return self.activation(self.gate(h)) * self.linear(h)

    def swept(self, h: Sweep, along: Along) -> Sweep:
        """`forward` with derivatives."""
        return h.linear(self.gate).activated(self.activation, along).times(h.linear(self.linear), along)


class PeriodicMLP(nn.Module):
    """`x -> shift + scale * net(embedding(x))`, ``(N, d) -> (N,)`` or, with ``outputs``, ``(N, outputs)``.

    ``shift`` and ``scale`` are constants in the units of what is represented, so that one learning rate suits costs of
    any size. With ``gated`` each hidden layer multiplies two halves (`Gated`). The last layer starts small: the field
    starts near the constant ``shift``. A ``centred`` network is made to be fitted to given values: its embedding has
    features about a state of rest (`Centred`), its activation is gelu, and ``waves`` other than 0 are at least 32.
    """

    shift: Tensor
    scale: Tensor

    def __init__(
        self,
        dim: int,
        outputs: int | None = None,
        modes: int = 3,
        width: int = 96,
        depth: int = 3,
        activation: str = "gelu",
        gated: bool = False,
        waves: int = 0,
        shift: float = 0.0,
        scale: float = 1.0,
        centred: bool = False,
    ) -> None:
        super().__init__()
        width = require_integer("model.width", width, 1, maximum=2**14)
        depth = require_integer("model.depth", depth, 1, maximum=64)
        activate = ACTIVATIONS[require_choice("model.activation", activation, ACTIVATIONS)]
        if centred:
            activate, waves = ACTIVATIONS[FITTED_ACTIVATION], max(waves, FITTED_WAVES) if waves else 0
        self.embedding = FourierEmbedding(dim, modes, waves)
        self.centred = Centred(dim) if centred else None
        sizes = [self.embedding.width + (self.centred.width if self.centred else 0)] + [width] * depth
        require_flag("model.gated", gated)
        layers: list[nn.Module] = []
        for inward, outward in zip(sizes, sizes[1:], strict=False):
            layers += [Gated(inward, outward, activate())] if gated else [nn.Linear(inward, outward), activate()]
        self.body = nn.Sequential(*layers)
        for module in self.body.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_normal_(module.weight)
                nn.init.zeros_(module.bias)
        self.head = nn.Linear(width, 1 if outputs is None else outputs)
        nn.init.normal_(self.head.weight, std=0.1 / width**0.5)
        nn.init.zeros_(self.head.bias)
        self.scalar = outputs is None
        self.register_buffer("shift", torch.tensor(float(shift)))
        self.register_buffer("scale", torch.tensor(float(scale)))

    @classmethod
    def defaults(cls, dim: int, worst_state: bool = False, noisy: bool = False) -> dict:
        """The best measured arguments in dimension ``dim``, by name; ``worst_state`` says that the bound is decided by the
        worst state and not by an average."""
        sizes = next(sizes for largest, sizes in SIZES.items() if dim <= largest)
        sizes = UNGATED_SIZES if 2 < dim <= 4 and (worst_state or noisy) else sizes
        if noisy and dim == 1:
            sizes = {**sizes, "modes": NOISY_MODES}
        if not worst_state:
            return {**sizes, "activation": "tanh"}
        enough = max(LEAST_WAVES, WAVES_PER_COORDINATE * dim, comb(dim, 2))
        return {**sizes, **WORST_STATE_OPTIONS, "waves": WAVES_IN_TWO if dim <= 2 else min(sizes["waves"], enough)}

    @torch.no_grad()
    def add_waves(self, waves: Tensor) -> None:
        """Take the wave vectors ``waves`` ``(W, d)``, as many as the embedding has room for, and stay the same function: the
        weights of the new features start at 0, and the biases take over what the old constant features gave."""
        cosines, sines = self.embedding.mix(waves)
        first: nn.Module = self.body[0]
        for layer in first.modules():
            if isinstance(layer, nn.Linear):
                layer.bias.add_(layer.weight[:, cosines].sum(dim=1))
                layer.weight[:, cosines + sines] = 0.0

    def forward(self, x: Tensor) -> Tensor:
        features = self.embedding(x)
        if self.centred is not None:
            features = torch.cat([features, self.centred(x)], dim=-1)
        out = self.shift + self.scale * self.head(self.body(features))
        return out.squeeze(-1) if self.scalar else out

    @property
    def can_be_swept(self) -> bool:
        """Whether the hand-written sweeps, which go layer by layer, give what `forward` gives."""
        return self.centred is None and type(self).forward is PeriodicMLP.forward

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """The jet of a scalar network at states ``(N, d)``: by `reverse_sweep`, or with noise ``sigma`` ``(N, d, k)`` by
        `forward_sweep`, at `min(d, k) + 2` times the work of `forward`; by autograd's reverse passes where the network cannot
        be swept, or states are differentiated without noise."""
        if not self.can_be_swept or (sigma is None and not is_data(x)):
            return reverse_jet(self, x, sigma)
        if sigma is None:
            return swept_jet(self, x)
        along = Along.of(sigma)
        if along.columns is None:
            swept = self._swept(x, along)
            return Jet(swept.value, along.gradient(swept.slopes), swept.curvature)
        curvature: list[Tensor] = []

        def value(at: Tensor) -> Tensor:
            swept = self._swept(at, along)
            curvature.append(swept.curvature)
            return swept.value

        of = reverse_jet(value, x)
        return Jet(of.value, of.gradient, curvature[0] if torch.is_grad_enabled() else curvature[0].detach())

    def curvature(self, x: Tensor, sigma: Tensor) -> Tensor:
        """`sigma sigma^T / 2 : hess` ``(N,)`` of a scalar network at states ``(N, d)``, for data ``sigma`` ``(N, d, k)``."""
        if not self.can_be_swept or not is_data(x):
            return reverse_jet(self, x, sigma).curvature
        rows = max(LEAST_SWEEP_STATES, SWEEP_SIZE // sigma.shape[2])
        pieces = zip(x.split(rows), sigma.split(rows), strict=True)
        return torch.cat([self._swept(at, Along(columns=s)).curvature for at, s in pieces])

    def layers(self) -> list[Layer]:
        """The hidden layers, for `ReverseSweep`."""
        hidden: list[Any] = list(self.body)
        if isinstance(hidden[0], Gated):
            return [Product(layer.gate, layer.linear, layer.activation) for layer in hidden]
        return [Dense(linear, activation) for linear, activation in zip(hidden[::2], hidden[1::2], strict=True)]

    def _swept(self, x: Tensor, along: Along) -> Sweep:
        """The field ``(N,)``, its derivatives ``(p, N)`` and its curvature ``(N,)``."""
        h = Sweep.embedded(self.embedding, x, along)
        for layer in self.body:
            if isinstance(layer, Gated):
                h = layer.swept(h, along)
            else:
                h = h.linear(layer) if isinstance(layer, nn.Linear) else h.activated(layer, along)
        out = h.linear(self.head)
        part = lambda t: (self.scale * t).squeeze(-1)
        return Sweep(self.shift + part(out.value), part(out.slopes), part(out.curvature))
