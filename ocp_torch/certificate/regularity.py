"""Is a controller regular? Jumps, found by halving segments between states until only a jump is left to see."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.control_laws import ControlLaw

SEGMENTS = 768
# Halvings, after which the longest segment is 3e-11 long: what still changes across it is no slope.
HALVINGS = 34
# A change relative to the largest control met that counts as a jump; above the noise of a controller in float32.
NOTICEABLE = 1e-5


@dataclass(frozen=True)
class Jump:
    """The largest jump found, `|u(x+) - u(x-)|`, and where; ``size`` is 0 where none was."""

    size: float
    x: Tensor


@torch.no_grad()
def largest_jump(law: ControlLaw, dim: int, seed: int = 0) -> Jump:
    """Follow, on segments of all lengths, the half across which the control changes more.

    For a Lipschitz controller the change halves with the length; a jump that is followed stays. A jump much smaller than
    what the controller changes nearby anyway, or on a tiny set, can be missed.
    """
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, dtype=torch.float64, generator=generator)
    left = draw(SEGMENTS, dim)
    direction = torch.nn.functional.normalize(torch.randn(SEGMENTS, dim, dtype=torch.float64, generator=generator))
    right = left + direction * 10.0 ** (-3.0 * draw(SEGMENTS, 1)) * 0.5
    u_left, u_right = law(left), law(right)
    scale = float(torch.maximum(u_left.norm(dim=-1), u_right.norm(dim=-1)).max())
    for _ in range(HALVINGS):
        middle = 0.5 * (left + right)
        u_middle = law(middle)
        first = ((u_middle - u_left).norm(dim=-1) > (u_right - u_middle).norm(dim=-1)).unsqueeze(-1)
        left, u_left = torch.where(first, left, middle), torch.where(first, u_left, u_middle)
        right, u_right = torch.where(first, middle, right), torch.where(first, u_middle, u_right)
    change = (u_right - u_left).norm(dim=-1).nan_to_num(nan=0.0)
    worst = int(change.argmax())
    size = float(change[worst])
    return Jump(size if size > NOTICEABLE * scale else 0.0, left[worst].remainder(1.0))
