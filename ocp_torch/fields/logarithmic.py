"""A network that gives the logarithm of what is represented, so that small values count as much as large ones."""

import math
from typing import Any

import torch
from torch import Tensor, nn

from ocp_torch.maths import jets
from ocp_torch.maths.jets import Jet

# The unit, in standard deviations of the state cost: far below it `V` is linear in the network, far above exponential. That
# of a pendulum with little torque rises from 0.2 to 12 within a tenth of a radian, and must still tell 0.01 from 0.02: fitted
# to what a grid gave, a plain network lost 9 to 48 % of the return of Pendulum-v1, and this one 7 %. After 150
# rounds an acrobot cost 2.90 with 0.05, and 2.70 with 0.01 and a rate that falls.
UNIT = 0.01


class Logarithmic(nn.Module):
    """`x -> unit (e^{logarithm(x)} - 1)`, ``(N, d) -> (N,)``, for a scalar network, which may resolve a state of rest."""

    unit: Tensor

    def __init__(self, network: nn.Module, unit: float) -> None:
        super().__init__()
        self.logarithm = network
        self.register_buffer("unit", torch.tensor(float(unit)))

    @classmethod
    def of(cls, network: Any, shift: float = 0.0, scale: float = 1.0, **form: Any) -> "Logarithmic":
        """One that starts near ``shift >= 0``, of a `V` that varies by about ``scale``; ``network`` makes what it is of."""
        unit = UNIT * scale
        return cls(network(shift=math.log1p(max(shift, 0.0) / unit), scale=1.0, centred=True, **form), unit)

    def forward(self, x: Tensor) -> Tensor:
        return self.unit * (self.logarithm(x).exp() - 1.0)

    def jet(self, x: Tensor, sigma: Tensor | None = None) -> Jet:
        """The jet at states ``(N, d)`` with noise ``sigma`` ``(N, d, k)``, as `jets.jet` has it, by the chain rule."""
        z = jets.jet(self.logarithm, x, sigma)
        grown = self.unit * z.value.exp()
        curvature = None
        if sigma is not None:
            along = torch.einsum("nd,ndk->nk", z.gradient, sigma)
            curvature = grown * (z.curvature + 0.5 * along.square().sum(dim=-1))
        return Jet(grown - self.unit, grown.unsqueeze(-1) * z.gradient, curvature)
