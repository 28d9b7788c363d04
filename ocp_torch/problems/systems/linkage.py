r"""What arms of turning joints share, in the plane and in space: a tip that is to reach a target, past round obstacles."""

import math
from abc import abstractmethod

import torch
from torch import Tensor

from ocp_torch.problems.systems.angles import to_radians, to_turns
from ocp_torch.problems.systems.reaching import Reaching, bump


class Linkage(Reaching):
    r"""`dx/dt = speed u` and `f = target_weight |p(x) - target|^2 + obstacle_weight sum_o (1 - prod_s (1 - b_o(r_s(x))))`.

    `x_i` is the angle of joint `i` in turns, so that the state space is exactly the torus and there is no drift; `u = 1`
    turns a joint by ``speed`` turns per second. `p` is the tip, and `s` runs over ``points_per_link`` points of each link,
    where the bump `b_o` of an obstacle is 1 at its centre and 0 from ``clearance`` metres outside its surface on; all is
    twice differentiable. A subclass gives `joints` and `jacobian`, sets ``speed``, and calls `pursue` and `stretch`.
    """

    points_per_link = 8
    speed: float  # turns per second at `u = 1`

    def stretch(self, length: float, shoulder: list[float]) -> None:
        """Note that the tip stays within ``length`` metres of the ``shoulder``, the first joint's place."""
        self.length, self.shoulder = length, shoulder
        self.bound_cost((math.hypot(*shoulder) + length + math.hypot(*self.target)) ** 2)
        self.occupation_bound = math.inf

    @abstractmethod
    def joints(self, x: Tensor) -> Tensor:
        """The corners of the arm from base to tip in metres, ``(N, k, c)`` with `c` coordinates."""

    @abstractmethod
    def jacobian(self, x: Tensor) -> Tensor:
        """`dp / d angle` in metres per radian, ``(N, c, n)``."""

    def end_effector(self, x: Tensor) -> Tensor:
        """`p(x)` in metres, ``(N, c)``."""
        return self.joints(x)[:, -1]

    def to_target(self, x: Tensor) -> Tensor:
        return self._like(x, "target", self._target) - self.end_effector(x)

    def gaps(self, x: Tensor, balls: Tensor) -> Tensor:
        joints = self.joints(x)
        start, link = joints[:, :-1].unsqueeze(2), joints.diff(dim=1).unsqueeze(2)
        away = balls[:, :-1] - start
        square = link.square().sum(dim=-1).clamp_min(torch.finfo(x.dtype).tiny)  # joints may share a place
        nearest = ((away * link).sum(dim=-1) / square).clamp(0.0, 1.0)
        return (away - nearest.unsqueeze(-1) * link).norm(dim=-1) - balls[:, -1]

    def state_cost(self, x: Tensor) -> Tensor:
        joints = self.joints(x)
        off = (joints[:, -1] - self._like(x, "target", self._target)).square().sum(dim=-1)
        cost = self.target_weight * off
        if not self.obstacles:
            return cost
        balls = self._like(x, "balls", self._balls)
        along = torch.arange(1, self.points_per_link + 1).to(x).unsqueeze(-1) / self.points_per_link
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
