r"""An arm as its URDF file describes it, under joint-velocity control: bring the tip to a point, past round obstacles."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number, require_numbers, shown
from ocp_torch.problems.systems.angles import TURN
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.urdf import read_chain

# Without a file, an elbow arm of the usual build: where each joint sits against the one before, in metres, and its axis.
ELBOW = [
    [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z, *axis]
    for (x, y, z), axis in (
        ((0.0, 0.0, 0.2), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.2), (0.0, 1.0, 0.0)),
        ((0.4, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((0.2, 0.0, 0.0), (1.0, 0.0, 0.0)),
        ((0.2, 0.0, 0.0), (0.0, 1.0, 0.0)),
        ((0.1, 0.0, 0.0), (1.0, 0.0, 0.0)),
        ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)),
    )
]


class RobotArm(Linkage):
    r"""`dx/dt = speed u` and `f = target_weight |p(x) - target|^2 + obstacle_weight sum_o (1 - prod_s (1 - b_o(r_s(x))))`.

    `Arm` in space: `x_i` is the angle of joint `i` in turns, `p = T_1 R_1(x_1) ... T_n R_n(x_n) T_tip 0` in metres, with the
    fixed transforms `T` and rotations `R` about the joints' axes that the ``urdf`` file names up to the link ``tip`` (null:
    the last one that turning joints move; without a file, a six-joint elbow arm). Every joint turns all the way round:
    limits of joints are not part of the model. ``obstacles`` are balls `[x, y, z, radius]`, felt ``clearance`` metres from
    their surface, along the lines from joint to joint. ``speed`` in turns per second at `u = 1`.

    ``chain`` is the kinematics as numbers (`ocp_torch.problems.systems.urdf.read_chain`), in place of ``urdf``: what a saved
    controller holds. `mu*` is declared unbounded, as for `Arm`. Raises `InputError` for wrong arguments.
    """

    points_per_link = 4  # six joints and more: the cost of obstacles is most of the work

    def __init__(
        self,
        urdf: str | None = None,
        tip: str | None = None,
        chain: list[list[float]] | None = None,
        target: Sequence[float] = (0.4, 0.2, 0.5),
        obstacles: Sequence[Sequence[float]] = (),
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
        if tip is not None and urdf is None:
            raise InputError(f"problem.tip is {shown(tip)}, but it names a link of problem.urdf, which is not given.")
        given = read_chain(urdf, tip) if urdf is not None else ELBOW if chain is None else chain
        if isinstance(given, str) or not isinstance(given, Sequence) or len(given) < 2:
            raise InputError(
                "problem.chain must be a list of rows of 15 numbers, one for each joint and one for the tip."
            )
        self.chain = [require_numbers(f"problem.chain[{i}]", row, 15) for i, row in enumerate(given)]
        joints = len(self.chain) - 1
        super().__init__(joints, joints, discount, exponent, control_limit)
        self.pursue(3, target, obstacles, clearance, target_weight, obstacle_weight)
        self.speed = require_number("problem.speed", speed, above=0.0)
        self.urdf, self.tip = None, None  # a saved controller needs no file
        rows = torch.tensor(self.chain, dtype=torch.float64)
        self._fixed, self._axes = rows[:, :12].reshape(-1, 3, 4), rows[:-1, 12:]
        # The cross product with an axis as a matrix: R = I + sin K + (1 - cos) K K (Rodrigues).
        self._turners = torch.linalg.cross(torch.eye(3).double().expand(self.dim, 3, 3), self._axes[:, None], dim=-1)
        steps = self._fixed[:, :, 3]
        self.stretch(float(steps[1:].norm(dim=-1).sum()), steps[0].tolist())

    def _frames(self, x: Tensor) -> tuple[Tensor, list[Tensor]]:
        """What `joints` gives, and the frame that each joint turns in, `n` times ``(N, 3, 3)``."""
        angle = (TURN * x)[..., None, None]
        fixed, K = self._like(x, "fixed", self._fixed), self._like(x, "turners", self._turners)
        turns = torch.eye(3).to(x) + angle.sin() * K + (1.0 - angle.cos()) * (K @ K)
        rotation, at = torch.eye(3).to(x).expand(len(x), 3, 3), x.new_zeros(len(x), 3)
        points, held = [at], []
        for i in range(self.dim + 1):
            at = at + rotation @ fixed[i, :, 3]
            points.append(at)
            if i < self.dim:
                held.append(rotation @ fixed[i, :, :3])
                rotation = held[-1] @ turns[:, i]
        return torch.stack(points, dim=1), held

    def joints(self, x: Tensor) -> Tensor:
        """The base, each joint and the tip in metres, ``(N, n + 2, 3)``."""
        return self._frames(x)[0]

    def jacobian(self, x: Tensor) -> Tensor:
        joints, held = self._frames(x)
        axes = torch.stack(held, dim=1) @ self._like(x, "axes", self._axes).unsqueeze(-1)
        return torch.linalg.cross(axes.squeeze(-1), joints[:, -1:] - joints[:, 1:-1], dim=-1).mT
