r"""What vehicles in a periodic plane share: position and heading, a target, round obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.problems.arguments import require_numbers, require_obstacles
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.angles import TURN, bump, to_radians, to_turns


class PlanarVehicle(Problem):
    r"""State `(x_1, x_2, x_3)`: the position in periods of ``size`` metres, and the heading in turns.

    `f = target_weight r(x)^2 + obstacle_weight sum_o b_o(x)`, with the smooth periodic distance
    `r^2 = (size/pi)^2 (sin^2 pi(x_1 - g_1) + sin^2 pi(x_2 - g_2))` in metres from the target `g`, and bumps `b_o` that are 1
    at the centre of an obstacle and 0 from ``clearance`` metres outside its rim on. Positions are in metres, in [0, size).
    """

    def __init__(
        self,
        control_dim: int,
        size: float,
        target: Sequence[float],
        obstacles: Sequence[Sequence[float]],
        clearance: float,
        target_weight: float,
        obstacle_weight: float,
        discount: float,
        exponent: float,
        control_limit: float | None,
    ) -> None:
        super().__init__(3, control_dim, discount, exponent, control_limit)
        self.size = require_number("problem.size", size, above=0.0)
        self.target = require_numbers("problem.target", target, 2)
        self.obstacles = require_obstacles("problem.obstacles", obstacles)
        self.clearance = require_number("problem.clearance", clearance, above=0.0)
        self.target_weight = require_number("problem.target_weight", target_weight, above=0.0)
        self.obstacle_weight = require_number("problem.obstacle_weight", obstacle_weight, at_least=0.0)
        self._target = torch.tensor(self.target, dtype=torch.float64)
        self._discs = torch.tensor(self.obstacles, dtype=torch.float64).reshape(-1, 3)
        farthest = 2.0 * (self.size / math.pi) ** 2
        self.state_cost_bound = self.target_weight * farthest + self.obstacle_weight * len(self.obstacles)

    def heading(self, x: Tensor) -> Tensor:
        """The unit vector ahead, ``(N, 2)``."""
        angle = TURN * x[:, 2]
        return torch.stack([angle.cos(), angle.sin()], dim=-1)

    def _square_distances(self, x: Tensor, points: Tensor) -> Tensor:
        """Smooth periodic `r^2` from ``points`` ``(k, 2)`` in metres, ``(N, k)``."""
        turns = x[:, None, :2] - points / self.size
        return (self.size / math.pi) ** 2 * (math.pi * turns).sin().square().sum(dim=-1)

    def offsets(self, x: Tensor, points: Tensor) -> Tensor:
        """The shortest way to ``points`` ``(k, 2)``, in metres, ``(N, k, 2)``."""
        return ((points / self.size - x[:, None, :2] + 0.5).remainder(1.0) - 0.5) * self.size

    def to_target(self, x: Tensor) -> Tensor:
        """The shortest way to the target, in metres, ``(N, 2)``."""
        return self.offsets(x, self._like(x, "target", self._target).unsqueeze(0))[:, 0]

    def distance(self, x: Tensor) -> Tensor:
        """From the target, in metres, ``(N,)``."""
        return self.to_target(x).norm(dim=-1)

    def gap(self, x: Tensor) -> Tensor:
        """From the nearest rim of an obstacle, in metres, ``(N,)``; negative inside, infinite without obstacles."""
        if not self.obstacles:
            return torch.full_like(x[:, 0], math.inf)
        discs = self._like(x, "discs", self._discs)
        return (self.offsets(x, discs[:, :2]).norm(dim=-1) - discs[:, 2]).amin(dim=-1)

    def state_cost(self, x: Tensor) -> Tensor:
        target = self._like(x, "target", self._target).unsqueeze(0)
        cost = self.target_weight * self._square_distances(x, target)[:, 0]
        if not self.obstacles:
            return cost
        discs = self._like(x, "discs", self._discs)
        bumps = bump(self._square_distances(x, discs[:, :2]), discs[:, 2] + self.clearance)
        return cost + self.obstacle_weight * bumps.sum(dim=-1)

    def to_torus(self, physical: Tensor) -> Tensor:
        """Positions in metres and headings in radians ``(N, 3)`` as states."""
        position = (physical[:, :2] / self.size).remainder(1.0)
        return torch.cat([position, to_turns(physical[:, 2:])], dim=-1)

    def from_torus(self, x: Tensor) -> Tensor:
        """States as positions in [0, size) metres and headings in [-pi, pi) radians, ``(N, 3)``."""
        return torch.cat([x[:, :2].remainder(1.0) * self.size, to_radians(x[:, 2:])], dim=-1)
