r"""The base class of arms of turning joints, in the plane and in space: a tip is to reach a target, past round obstacles."""

import math
from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.problems.constant_noise import one_or_each
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.coordinates import Angle
from ocp_torch.problems.physical.units import TURN
from ocp_torch.problems.systems.reaching import Reaching, bump


class Linkage(Reaching):
    r"""`ds/dt = w` and `cost = target_weight |p(s) - target|^2 + obstacle_weight sum_o (1 - prod_k (1 - b_o(r_k(s))))`.

    States are the angles of the joints in rad, so that their space is exactly the torus and there is no drift, controls their
    rates in rad/s, with the price `|u|^q / q` of `u = w` in units of ``speed`` turns per second. `p` is the tip, and `k` runs
    over ``points_per_link`` points of each link, where the bump `b_o` of an obstacle is 1 at its centre and 0 from
    ``clearance`` metres outside its surface on; all is twice differentiable. A subclass gives `joints` and `jacobian`, and
    calls `__init__`, `pursue` and `stretch`.
    """

    driftless = divergence_free = True
    points_per_link = 8

    def __init__(
        self,
        joints: int,
        speed: float,
        joint_noise: float | Sequence[float],
        discount: float,
        exponent: float,
        control_limit: Limit,
        noise: float | Sequence[float],
    ) -> None:
        """``joint_noise`` is in rad/sqrt(s), one for each joint or one for all; ``speed`` in turns per second."""
        self.speed, self.joint_noise = require_number("problem.speed", speed, above=0.0), joint_noise
        angles = [Angle(f"joint {i + 1}") for i in range(joints)]
        rates = [f"rate {i + 1} [rad/s]" for i in range(joints)]
        nominal = TURN * self.speed
        super().__init__(angles, rates, discount, exponent, 1.0, control_limit, noise=noise, nominal_control=nominal)
        each = one_or_each("problem.joint_noise", joint_noise, self.dim)
        self.disturb(torch.tensor(each, dtype=torch.float64).diag())

    def stretch(self, length: float, shoulder: list[float]) -> None:
        """Set the reach: the tip stays within ``length`` metres of the ``shoulder``, the first joint's place."""
        self.length, self.shoulder = length, shoulder
        self.bound_cost((math.hypot(*shoulder) + length + math.hypot(*self.target)) ** 2)
        # With noise the flow does not gather on a point.
        self.occupation_bound = None if self.noisy else math.inf

    @abstractmethod
    def joints(self, s: Tensor) -> Tensor:
        """The corners of the arm from base to tip in metres, ``(N, k, c)`` with `c` coordinates."""

    @abstractmethod
    def jacobian(self, s: Tensor) -> Tensor:
        """`dp / d angle` in metres per radian, ``(N, c, n)``."""

    def end_effector(self, s: Tensor) -> Tensor:
        """`p(s)` in metres, ``(N, c)``."""
        return self.joints(s)[:, -1]

    def to_target(self, x: Tensor) -> Tensor:
        return self._like(x, "target", self._target) - self.end_effector(self.from_torus(x))

    def gaps(self, x: Tensor, balls: Tensor) -> Tensor:
        joints = self.joints(self.from_torus(x))
        start, link = joints[:, :-1].unsqueeze(2), joints.diff(dim=1).unsqueeze(2)
        away = balls[:, :-1] - start
        square = link.square().sum(dim=-1).clamp_min(torch.finfo(x.dtype).tiny)  # joints may share a place
        nearest = ((away * link).sum(dim=-1) / square).clamp(0.0, 1.0)
        return (away - nearest.unsqueeze(-1) * link).norm(dim=-1) - balls[:, -1]

    def cost(self, s: Tensor) -> Tensor:
        joints = self.joints(s)
        off = (joints[:, -1] - self._like(s, "target", self._target)).square().sum(dim=-1)
        cost = self.target_weight * off
        if not self.obstacles:
            return cost
        balls = self._like(s, "balls", self._balls)
        along = (
            torch.arange(1, self.points_per_link + 1, dtype=s.dtype, device=s.device).unsqueeze(-1)
            / self.points_per_link
        )
        points = joints[:, :-1].unsqueeze(2) + along * joints.diff(dim=1).unsqueeze(2)  # (N, links, points, c)
        square = (points.unsqueeze(-2) - balls[:, :-1]).square().sum(dim=-1)
        missed = (1.0 - bump(square, balls[:, -1] + self.clearance)).flatten(1, 2).prod(dim=1)  # (N, obstacles)
        return cost + self.obstacle_weight * (1.0 - missed).sum(dim=-1)

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(s), torch.eye(self.dim, dtype=s.dtype, device=s.device).expand(len(s), -1, -1)
