r"""A planar arm of `n` revolute joints under joint-velocity control: reach a target, keep the links off round obstacles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.problems.angles import TURN, bump, to_radians, to_turns
from ocp_torch.problems.arguments import require_numbers, require_obstacles
from ocp_torch.problems.problem import Problem

# Points of a link at which the cost of obstacles is taken, at equal distances.
POINTS_PER_LINK = 8
TARGET = (0.2, 0.65)
OBSTACLES = ((0.75, -0.4, 0.08),)


class Arm(Problem):
    r"""`dx/dt = speed u` and `f = target_weight |p(x) - target|^2 + obstacle_weight sum_o (1 - prod_s (1 - b_o(r_s(x))))`.

    `x_i` is the angle of joint `i` against the link before it, in turns; the state space is exactly the torus and there is
    no drift. Joint `i` ends at `r_i = r_{i-1} + l_i (cos, sin)(2 pi (x_1 + ... + x_i))`, in metres from the base, and the
    end effector is `p = r_n` (Murray, Li, Sastry: *A Mathematical Introduction to Robotic Manipulation*, chapter 3).
    `u = 1` turns a joint by ``speed`` turns per second. `s` runs over points of all links; `b_o` is 1 at the centre of an
    obstacle and falls to 0 at ``clearance`` metres from its rim, so that an obstacle costs about ``obstacle_weight`` where
    any part of the arm is inside; everything is twice differentiable.

    ``lengths`` in metres, by default 1 / dim each; ``target`` `[x, y]`; ``obstacles`` a list of `[x, y, radius]`. The
    optimal flow contracts onto the configurations that reach the target: `mu*` is declared unbounded, and no `M` makes
    `F_M` a bound, with a control limit or without, as the control is small there. Raises `InputError` for wrong arguments.
    """

    def __init__(
        self,
        dim: int = 2,
        lengths: list[float] | None = None,
        target: list[float] = TARGET,
        obstacles: list[list[float]] = OBSTACLES,
        clearance: float = 0.2,
        target_weight: float = 1.0,
        obstacle_weight: float = 3.0,
        speed: float = 0.35,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: float | None = None,
    ) -> None:
        super().__init__(dim=dim, discount=discount, exponent=exponent, control_limit=control_limit)
        equal = [1.0 / self.dim] * self.dim
        self.lengths = equal if lengths is None else require_numbers("problem.lengths", lengths, self.dim, above=0.0)
        self.target = require_numbers("problem.target", target, 2)
        self.obstacles = require_obstacles("problem.obstacles", obstacles)
        self.clearance = require_number("problem.clearance", clearance, above=0.0)
        self.target_weight = require_number("problem.target_weight", target_weight, above=0.0)
        self.obstacle_weight = require_number("problem.obstacle_weight", obstacle_weight, at_least=0.0)
        self.speed = require_number("problem.speed", speed, above=0.0)
        self._lengths = torch.tensor(self.lengths, dtype=torch.float64)
        self._target = torch.tensor(self.target, dtype=torch.float64)
        self._discs = torch.tensor(self.obstacles, dtype=torch.float64).reshape(-1, 3)
        self._along = torch.arange(1, POINTS_PER_LINK + 1, dtype=torch.float64) / POINTS_PER_LINK
        farthest = sum(self.lengths) + math.hypot(*self.target)
        self.state_cost_bound = self.target_weight * farthest**2 + self.obstacle_weight * len(self.obstacles)
        self.occupation_bound = math.inf

    def joints(self, x: Tensor) -> Tensor:
        """Base, joints and end effector in metres, ``(N, n + 1, 2)``."""
        angle = TURN * x.cumsum(dim=-1)
        links = torch.stack([angle.cos(), angle.sin()], dim=-1) * self._like(x, "lengths", self._lengths).unsqueeze(-1)
        return torch.cat([links.new_zeros(len(x), 1, 2), links.cumsum(dim=1)], dim=1)

    def end_effector(self, x: Tensor) -> Tensor:
        """`p(x)` in metres, ``(N, 2)``."""
        return self.joints(x)[:, -1]

    def distance(self, x: Tensor) -> Tensor:
        """From the end effector to the target, in metres, ``(N,)``."""
        return (self.end_effector(x) - self._like(x, "target", self._target)).norm(dim=-1)

    def gap(self, x: Tensor) -> Tensor:
        """From the links to the nearest rim of an obstacle, in metres, ``(N,)``; negative inside, infinite without any."""
        if not self.obstacles:
            return torch.full_like(x[:, 0], math.inf)
        discs = self._like(x, "discs", self._discs)
        joints = self.joints(x)
        start, link = joints[:, :-1].unsqueeze(2), joints.diff(dim=1).unsqueeze(2)
        away = discs[:, :2] - start
        nearest = ((away * link).sum(dim=-1) / link.square().sum(dim=-1)).clamp(0.0, 1.0)
        distance = (away - nearest.unsqueeze(-1) * link).norm(dim=-1) - discs[:, 2]
        return distance.flatten(1).amin(dim=1)

    def state_cost(self, x: Tensor) -> Tensor:
        joints = self.joints(x)
        off = (joints[:, -1] - self._like(x, "target", self._target)).square().sum(dim=-1)
        cost = self.target_weight * off
        if not self.obstacles:
            return cost
        discs = self._like(x, "discs", self._discs)
        along = self._like(x, "along", self._along).unsqueeze(-1)
        points = joints[:, :-1].unsqueeze(2) + along * joints.diff(dim=1).unsqueeze(2)  # (N, n, points, 2)
        square = (points.unsqueeze(-2) - discs[:, :2]).square().sum(dim=-1)
        missed = (1.0 - bump(square, discs[:, 2] + self.clearance)).flatten(1, 2).prod(dim=1)  # (N, obstacles)
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
