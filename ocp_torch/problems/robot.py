r"""An arm as its URDF file describes it, under joint-velocity control: bring the tip to a point, past round obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number
from ocp_torch.problems.angles import TURN, bump, to_radians, to_turns
from ocp_torch.problems.arguments import require_numbers, require_obstacles
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.urdf import read_chain

# Points of a link at which the cost of obstacles is taken, at equal distances from one joint to the next.
POINTS_PER_LINK = 4
# Without a file, an elbow arm of the usual build: where each joint sits against the one before, in metres, and its axis.
ELBOW = (
    ((0.0, 0.0, 0.2), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, 0.2), (0.0, 1.0, 0.0)),
    ((0.4, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.2, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ((0.2, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((0.1, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)),
)


class RobotArm(Problem):
    r"""`dx/dt = speed u` and `f = target_weight |p(x) - target|^2 + obstacle_weight sum_o (1 - prod_s (1 - b_o(r_s(x))))`.

    `Arm` in space: `x_i` is the angle of joint `i` in turns, `p = T_1 R_1(x_1) ... T_n R_n(x_n) T_tip 0` in metres, with the
    fixed transforms `T` and rotations `R` about the joints' axes that the ``urdf`` file names up to the link ``tip`` (null:
    the last one that turning joints move; without a file, a six-joint elbow arm). Every joint turns all the way round:
    limits of joints are not part of the model. ``obstacles`` are balls `[x, y, z, radius]`, felt ``clearance`` metres from
    their surface, along the lines from joint to joint. ``speed`` in turns per second at `u = 1`.

    ``chain`` is the kinematics as numbers (`ocp_torch.problems.urdf.read_chain`), in place of ``urdf``: what a saved
    controller holds. `mu*` is declared unbounded, as for `Arm`. Raises `InputError` for wrong arguments.
    """

    def __init__(
        self,
        urdf: str | None = None,
        tip: str | None = None,
        chain: list[list[float]] | None = None,
        target: list[float] = (0.4, 0.2, 0.5),
        obstacles: list[list[float]] = (),
        clearance: float = 0.15,
        target_weight: float = 1.0,
        obstacle_weight: float = 3.0,
        speed: float = 0.35,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: float | None = None,
    ) -> None:
        if urdf is not None and chain is not None:
            raise InputError("problem.urdf and problem.chain are both given, but either alone is the kinematics.")
        given = chain if urdf is None else read_chain(urdf, tip)
        given = _elbow() if given is None else given
        if isinstance(given, str) or not isinstance(given, Sequence) or len(given) < 2:
            raise InputError(
                "problem.chain must be a list of rows of 15 numbers, one for each joint and one for the tip."
            )
        self.chain = [require_numbers(f"problem.chain[{i}]", row, 15) for i, row in enumerate(given)]
        super().__init__(len(self.chain) - 1, discount=discount, exponent=exponent, control_limit=control_limit)
        self.urdf, self.tip = None, None  # a saved controller needs no file
        self.target = require_numbers("problem.target", target, 3)
        self.obstacles = require_obstacles("problem.obstacles", obstacles, space=3)
        self.clearance = require_number("problem.clearance", clearance, above=0.0)
        self.target_weight = require_number("problem.target_weight", target_weight, above=0.0)
        self.obstacle_weight = require_number("problem.obstacle_weight", obstacle_weight, at_least=0.0)
        self.speed = require_number("problem.speed", speed, above=0.0)
        rows = torch.tensor(self.chain, dtype=torch.float64)
        self._fixed, axes = rows[:, :12].reshape(-1, 3, 4), rows[:-1, 12:]
        # The cross product with an axis as a matrix: R = I + sin K + (1 - cos) K K (Rodrigues).
        self._turners = torch.linalg.cross(torch.eye(3).double().expand(self.dim, 3, 3), axes[:, None], dim=-1)
        self._target = torch.tensor(self.target, dtype=torch.float64)
        self._balls = torch.tensor(self.obstacles, dtype=torch.float64).reshape(-1, 4)
        reach = float(self._fixed[:, :, 3].norm(dim=-1).sum()) + math.hypot(*self.target)
        self.state_cost_bound = self.target_weight * reach**2 + self.obstacle_weight * len(self.obstacles)
        self.occupation_bound = math.inf

    def joints(self, x: Tensor) -> Tensor:
        """The base, each joint and the tip in metres, ``(N, n + 2, 3)``."""
        angle = (TURN * x)[..., None, None]
        fixed, K = self._like(x, "fixed", self._fixed), self._like(x, "turners", self._turners)
        turns = torch.eye(3).to(x) + angle.sin() * K + (1.0 - angle.cos()) * (K @ K)
        rotation, at = torch.eye(3).to(x).expand(len(x), 3, 3), x.new_zeros(len(x), 3)
        points = [at]
        for i in range(self.dim + 1):
            at = at + rotation @ fixed[i, :, 3]
            points.append(at)
            if i < self.dim:
                rotation = rotation @ fixed[i, :, :3] @ turns[:, i]
        return torch.stack(points, dim=1)

    def end_effector(self, x: Tensor) -> Tensor:
        """`p(x)` in metres, ``(N, 3)``."""
        return self.joints(x)[:, -1]

    def distance(self, x: Tensor) -> Tensor:
        """From the tip to the target, in metres, ``(N,)``."""
        return (self.end_effector(x) - self._like(x, "target", self._target)).norm(dim=-1)

    def state_cost(self, x: Tensor) -> Tensor:
        joints = self.joints(x)
        off = (joints[:, -1] - self._like(x, "target", self._target)).square().sum(dim=-1)
        cost = self.target_weight * off
        if not self.obstacles:
            return cost
        balls = self._like(x, "balls", self._balls)
        along = torch.arange(1, POINTS_PER_LINK + 1).to(x).unsqueeze(-1) / POINTS_PER_LINK
        points = (joints[:, :-1].unsqueeze(2) + along * joints.diff(dim=1).unsqueeze(2)).flatten(1, 2)
        square = (points.unsqueeze(-2) - balls[:, :3]).square().sum(dim=-1)
        missed = (1.0 - bump(square, balls[:, 3] + self.clearance)).prod(dim=1)
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


def _elbow() -> list[list[float]]:
    return [[1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z, *axis] for (x, y, z), axis in ELBOW]
