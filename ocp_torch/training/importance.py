r"""Where training states count: the size of the gradient of each state's part of the losses.

A loss is a mean of `l(x; theta)` over states. With states from a density `p` and weights `1/p` the variance of its gradient
is least for `p` proportional to `|grad_theta l(x)|`. That norm is estimated without gradients: for `v` with independent
standard normal entries, `E[(v . grad l)^2] = |grad l|^2`, and `v . grad l` is a difference of two values of `l`.
"""

import copy
from dataclasses import replace

import torch
from torch import Tensor

from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective, Phase
from ocp_torch.problems.samples import Samples

DIRECTIONS = 4  # random directions `v` for each player
# Length of the difference along them, as a part of the weights: short enough for a derivative to some percent, long enough
# for single precision.
STEP_LENGTH = 1e-2


def integrands(objective: Objective, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
    """The values ``(N,)`` at the states whose mean is the loss, for each player: `N` times its derivatives by the weights."""
    weight = torch.ones_like(samples.weight).requires_grad_()
    with torch.enable_grad():
        losses = objective.losses(fields, replace(samples, weight=weight, penalty_weight=None), phase)
        parts = {player: torch.autograd.grad(loss, weight, retain_graph=True)[0] for player, loss in losses.items()}
    return {player: len(samples) * part for player, part in parts.items()}


def scores(objective: Objective, fields: Fields, samples: Samples, phase: Phase, generator: torch.Generator) -> Tensor:
    """The size of the gradient of each state's part of the losses, ``(N,)``.

    Several players' squares, each in units of its own mean, are added under the root: the sum of their relative variances is
    then least. ``samples`` carry the divergences that the objective needs at ``phase``.
    """
    moved = copy.deepcopy(fields).requires_grad_(False)
    here = integrands(objective, moved, samples, phase)
    total = torch.zeros_like(samples.weight)
    for player, at in here.items():
        own = [p for name in objective.players[player] for p in moved.networks[name].parameters()]
        start, square = [p.clone() for p in own], torch.zeros_like(total)
        length = STEP_LENGTH * torch.cat([p.flatten() for p in own]).square().mean().sqrt()
        for _ in range(DIRECTIONS):
            for parameter, value in zip(own, start, strict=True):
                step = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype).to(parameter.device)
                parameter.copy_(value + length * step)
            square += (integrands(objective, moved, samples, phase)[player] - at).square()
        for parameter, value in zip(own, start, strict=True):
            parameter.copy_(value)
        square = torch.where(square.isfinite(), square, 0.0)
        total += square / square.mean().clamp_min(torch.finfo(square.dtype).tiny)
    return total.sqrt()
