r"""What arms of turning joints share, in the plane and in space: a tip that is to reach a target, round obstacles."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.problems.arguments import require_numbers, require_obstacles
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.angles import bump, to_radians, to_turns


class Linkage(Problem, ABC):
    r"""`dx/dt = speed u` and `f = target_weight |p(x) - target|^2 + obstacle_weight sum_o (1 - prod_s (1 - b_o(r_s(x))))`.

    `x_i` is the angle of joint `i` in turns, `p` the tip, and `s` runs over ``points_per_link`` points of each link, where
    the bump `b_o` of an obstacle is 1 at its centre and 0 from ``clearance`` metres outside its surface on. A subclass gives
    `joints` and `jacobian` in metres, and calls `stretch` once it knows its links. ``space`` is `c`, 2 or 3 coordinates.
    """

    points_per_link = 8

    def __init__(
        self,
        dim: int,
        space: int,
        target: Sequence[float],
        obstacles: Sequence[Sequence[float]],
        clearance: float,
        target_weight: float,
        obstacle_weight: float,
        speed: float,
        discount: float,
        exponent: float,
        control_limit: float | None,
    ) -> None:
        super().__init__(dim=dim, discount=discount, exponent=exponent, control_limit=control_limit)
        self.target = require_numbers("problem.target", target, space)
        self.obstacles = require_obstacles("problem.obstacles", obstacles, space)
        self.clearance = require_number("problem.clearance", clearance, above=0.0)
        self.target_weight = require_number("problem.target_weight", target_weight, above=0.0)
        self.obstacle_weight = require_number("problem.obstacle_weight", obstacle_weight, at_least=0.0)
        self.speed = require_number("problem.speed", speed, above=0.0)
        self._target = torch.tensor(self.target, dtype=torch.float64)
        self._balls = torch.tensor(self.obstacles, dtype=torch.float64).reshape(-1, space + 1)
        self._along = torch.arange(1, self.points_per_link + 1, dtype=torch.float64) / self.points_per_link
        self.occupation_bound = math.inf

    def stretch(self, length: float, shoulder: list[float]) -> None:
        """Note that the tip stays within ``length`` metres of the ``shoulder``, the first joint's place; bounds `f`."""
        self.length, self.shoulder = length, shoulder
        farthest = math.hypot(*shoulder) + length + math.hypot(*self.target)
        self.state_cost_bound = self.target_weight * farthest**2 + self.obstacle_weight * len(self.obstacles)

    @abstractmethod
    def joints(self, x: Tensor) -> Tensor:
        """The corners of the arm from base to tip in metres, ``(N, k, c)``."""

    @abstractmethod
    def jacobian(self, x: Tensor) -> Tensor:
        """`dp / d angle` in metres per radian, ``(N, c, n)``."""

    def end_effector(self, x: Tensor) -> Tensor:
        """`p(x)` in metres, ``(N, c)``."""
        return self.joints(x)[:, -1]

    def to_target(self, x: Tensor) -> Tensor:
        """From the tip to the target, in metres, ``(N, c)``."""
        return self._like(x, "target", self._target) - self.end_effector(x)

    def distance(self, x: Tensor) -> Tensor:
        """From the tip to the target, in metres, ``(N,)``."""
        return self.to_target(x).norm(dim=-1)

    def gap(self, x: Tensor) -> Tensor:
        """Metres from the links to the nearest obstacle's surface, ``(N,)``; negative inside, infinite without any."""
        if not self.obstacles:
            return torch.full_like(x[:, 0], math.inf)
        balls = self._like(x, "balls", self._balls)
        joints = self.joints(x)
        start, link = joints[:, :-1].unsqueeze(2), joints.diff(dim=1).unsqueeze(2)
        away = balls[:, :-1] - start
        square = link.square().sum(dim=-1).clamp_min(torch.finfo(x.dtype).tiny)  # joints may share a place
        nearest = ((away * link).sum(dim=-1) / square).clamp(0.0, 1.0)
        distance = (away - nearest.unsqueeze(-1) * link).norm(dim=-1) - balls[:, -1]
        return distance.flatten(1).amin(dim=1)

    def state_cost(self, x: Tensor) -> Tensor:
        joints = self.joints(x)
        off = (joints[:, -1] - self._like(x, "target", self._target)).square().sum(dim=-1)
        cost = self.target_weight * off
        if not self.obstacles:
            return cost
        balls = self._like(x, "balls", self._balls)
        along = self._like(x, "along", self._along).unsqueeze(-1)
        points = joints[:, :-1].unsqueeze(2) + along * joints.diff(dim=1).unsqueeze(2)  # (N, links, points, c)
        square = (points.unsqueeze(-2) - balls[:, :-1]).square().sum(dim=-1)
        missed = (1.0 - bump(square, balls[:, -1] + self.clearance)).flatten(1, 2).prod(dim=1)  # (N, obstacles)
        return cost + self.obstacle_weight * (1.0 - missed).sum(dim=-1)

    def control_matrix(self, x: Tensor) -> Tensor:
        return self.speed * super().control_matrix(x)

    def control_divergence(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def to_torus(self, angles: Tensor) -> Tensor:
        """Joint angles in radians ``(N, n)`` as states."""
        return to_turns(angles)

    def from_torus(self, x: Tensor) -> Tensor:
        """States as joint angles in [-pi, pi) radians, ``(N, n)``."""
        return to_radians(x)
