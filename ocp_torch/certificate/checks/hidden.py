r"""Does the divergence that sampled states see integrate to what the flux says? If not, some of it is hidden between them.

On a torus `E[phi div F] + E[F . grad phi] = 0` for every smooth `phi`, as long as `div F` is a function. Where `F` jumps, or
changes within a layer narrower than the distances between states, what pointwise divergences miss is what the sum differs
from 0 by. Here `phi` are plane waves, the constant among them: `E[r] = E[mu0] - E[mu]` for every Liouville residual `r`.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.statistics.estimate import t_factor
from ocp_torch.maths.plane_waves import plane_waves

TURN = 2.0 * math.pi
GROUPS = 32  # of states at least, whose scatter gives the standard error
FALSE_ALARM = 1e-4  # probability that any of the tests errs
MATERIAL = 1e-5  # part of the terms' mean size below which rounding and difference quotients explain a difference


@dataclass(frozen=True)
class Flux:
    """`div F` ``(N,)`` as seen at weighted states, and `F` ``(N, d)`` itself, both over `rho`."""

    x: Tensor
    weight: Tensor
    divergence: Tensor
    flux: Tensor


@dataclass(frozen=True)
class Hidden:
    """A divergence that is not seen: its ``size``, as mass per discount time against one wave, and a state ``x`` ``(d,)``
    near it."""

    size: float
    x: Tensor

    @property
    def sentence(self) -> str:
        at = [round(c, 2) for c in self.x[:6].tolist()] + (["..."] if len(self.x) > 6 else [])
        return (
            f"sampled states do not see {100.0 * self.size:.2g} % of the mass that the flux moves, near x = {at} if in one "
            "place: a jump, or a layer too narrow for them"
        )


@torch.no_grad()
def hidden_divergence(fluxes: list[Flux]) -> Hidden | None:
    """The divergence that the sets of ``fluxes`` together do not see; `None` where chance and rounding explain it."""
    waves = plane_waves(fluxes[0].x.shape[1])
    parts = max(1, math.ceil(GROUPS / len(fluxes)))
    # Consecutive points of a Sobol sequence are spread evenly, every other one of them is not.
    groups = [
        Flux(*columns)
        for f in fluxes
        for columns in zip(*(c.chunk(parts) for c in (f.x, f.weight, f.divergence, f.flux)), strict=True)
    ]
    found = torch.stack([_against(waves, group) for group in groups])  # (groups, waves), complex
    seen = [(f.weight * f.divergence.abs()).mean() for f in fluxes]
    moved = [(f.weight.unsqueeze(-1) * TURN * (f.flux @ waves.T).abs()).mean(dim=0) for f in fluxes]
    sizes = torch.stack([s + m for s, m in zip(seen, moved, strict=True)]).mean(dim=0)
    tests = torch.cat([found.real, found.imag], dim=1)
    mean, error = tests.mean(dim=0), tests.std(dim=0) / math.sqrt(len(groups))
    allowed = t_factor(1.0 - FALSE_ALARM / tests.shape[1], len(groups) - 1) * error + MATERIAL * sizes.repeat(2)
    excess = torch.where(allowed > 0.0, mean.abs() / allowed.clamp_min(1e-300), 0.0)
    if len(groups) < 2 or not float(excess.max()) > 1.0:
        return None
    worst = int(excess.argmax())
    states = torch.cat([f.x for f in fluxes])[:4096]
    shape = (torch.polar(torch.ones(()).to(states), TURN * states @ waves.T) * found.mean(dim=0)).real.sum(dim=1)
    return Hidden(float(mean[worst].abs()), states[int(shape.abs().argmax())].remainder(1.0))


def _against(waves: Tensor, f: Flux) -> Tensor:
    """`E[e^{-2 pi i k . x} (div F - 2 pi i k . F)]`: 0 for each wave ``(K,)`` where nothing is hidden."""
    phi = torch.polar(torch.ones(()).to(f.x), -TURN * f.x @ waves.T)
    terms = phi * torch.complex(f.divergence.unsqueeze(-1).expand(-1, len(waves)), -TURN * f.flux @ waves.T)
    return (f.weight.unsqueeze(-1) * terms).mean(dim=0)
