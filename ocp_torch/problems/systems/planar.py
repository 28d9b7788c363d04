r"""What vehicles in a periodic plane share: position and heading, a target, round obstacles."""

import math

import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.problems.systems.angles import TURN, to_radians, to_turns
from ocp_torch.problems.systems.reaching import Reaching, bump


class PlanarVehicle(Reaching):
    r"""State `(x_1, x_2, x_3)`: the position in periods of ``size`` metres, and the heading in turns.

    `f = target_weight r(x)^2 + obstacle_weight sum_o b_o(x)`, with the smooth periodic distance
    `r^2 = (size/pi)^2 (sin^2 pi(x_1 - g_1) + sin^2 pi(x_2 - g_2))` in metres from the target `g`, and bumps `b_o` that are 1
    at the centre of an obstacle and 0 from ``clearance`` metres outside its rim on. Positions are in metres, in [0, size).
    A subclass calls `pursue` and `drive`.
    """

    def drive(self, size: float, speed: float, turn_rate: float) -> None:
        """Note the ``size`` of the plane, the ``speed`` in metres and the ``turn_rate`` in turns per second."""
        self.size = require_number("problem.size", size, above=0.0)
        self.speed = require_number("problem.speed", speed, above=0.0)
        self.turn_rate = require_number("problem.turn_rate", turn_rate, above=0.0)
        self.bound_cost(2.0 * (self.size / math.pi) ** 2)

    def heading(self, x: Tensor) -> Tensor:
        """The unit vector ahead, ``(N, 2)``."""
        angle = TURN * x[:, 2]
        return torch.stack([angle.cos(), angle.sin()], dim=-1)

    def ahead(self, x: Tensor) -> Tensor:
        """What the vehicle's own speed does to the state, ``(N, 3)``."""
        velocity = self.speed / self.size * self.heading(x)
        return torch.cat([velocity, torch.zeros_like(velocity[:, :1])], dim=-1)

    def turning(self, x: Tensor) -> Tensor:
        """What its turn rate does to the state, ``(N, 3)``."""
        return x.new_tensor([0.0, 0.0, self.turn_rate]).expand(len(x), 3)

    def _square_distances(self, x: Tensor, points: Tensor) -> Tensor:
        """Smooth periodic `r^2` from ``points`` ``(k, 2)`` in metres, ``(N, k)``."""
        turns = x[:, None, :2] - points / self.size
        return (self.size / math.pi) ** 2 * (math.pi * turns).sin().square().sum(dim=-1)

    def _offsets(self, x: Tensor, points: Tensor) -> Tensor:
        """The shortest way to ``points`` ``(k, 2)``, in metres, ``(N, k, 2)``."""
        return ((points / self.size - x[:, None, :2] + 0.5).remainder(1.0) - 0.5) * self.size

    def to_target(self, x: Tensor) -> Tensor:
        return self._offsets(x, self._like(x, "target", self._target).unsqueeze(0))[:, 0]

    def gaps(self, x: Tensor, balls: Tensor) -> Tensor:
        return self._offsets(x, balls[:, :2]).norm(dim=-1) - balls[:, 2]

    def state_cost(self, x: Tensor) -> Tensor:
        target = self._like(x, "target", self._target).unsqueeze(0)
        cost = self.target_weight * self._square_distances(x, target)[:, 0]
        if not self.obstacles:
            return cost
        discs = self._like(x, "balls", self._balls)
        bumps = bump(self._square_distances(x, discs[:, :2]), discs[:, 2] + self.clearance)
        return cost + self.obstacle_weight * bumps.sum(dim=-1)

    def control_divergence(self, x: Tensor) -> Tensor:
        """Zero: the direction ahead does not depend on the position, nor the turn on the heading."""
        return x.new_zeros(len(x), self.control_dim)

    def to_torus(self, physical: Tensor) -> Tensor:
        """Positions in metres and headings in radians ``(N, 3)`` as states."""
        position = (physical[:, :2] / self.size).remainder(1.0)
        return torch.cat([position, to_turns(physical[:, 2:])], dim=-1)

    def from_torus(self, x: Tensor) -> Tensor:
        """States as positions in [0, size) metres and headings in [-pi, pi) radians, ``(N, 3)``."""
        return torch.cat([x[:, :2].remainder(1.0) * self.size, to_radians(x[:, 2:])], dim=-1)
