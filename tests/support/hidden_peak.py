"""A peak that the largest of sampled values do not lead to: it stands in a hollow, beside wide hills."""

import math

import torch
from torch import Tensor

from ocp_torch.problems import Problem

TURN = 2.0 * math.pi
# Of the hills, and of the peak: the hollow takes what the hills have there too.
HILLS, HEIGHT = 0.5, 1.5
PLACE = (0.237, 0.641)


def hidden_peak(x: Tensor) -> Tensor:
    """On the plane's torus: hills up to `HILLS`, and a hollow of radius .03 with a peak of radius .006, well above them."""
    turned = TURN * (x - torch.tensor(PLACE).to(x))
    distance = (2.0 - 2.0 * torch.cos(turned)).sum(dim=-1) / TURN**2
    hills = HILLS * torch.cos(turned - TURN * 0.4).mean(dim=-1)
    return hills - 3.0 * torch.exp(-distance / 0.03**2) + (3.0 + HEIGHT) * torch.exp(-distance / 0.006**2)


def top() -> float:
    """The height of the peak."""
    return float(hidden_peak(torch.tensor([PLACE], dtype=torch.float64)))


class Still(Problem):
    """Nothing moves, and hardly can: the slack of `V` is what it is above the cost."""

    def __init__(self) -> None:
        super().__init__(dim=2)

    def state_cost(self, x):
        return 1.0 + 0.5 * torch.cos(TURN * x[:, 0])

    def control_matrix(self, x):
        return 1e-9 * torch.eye(2).to(x).expand(len(x), 2, 2)
