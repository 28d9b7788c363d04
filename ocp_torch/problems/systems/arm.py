r"""A planar arm of `n` revolute joints under joint-velocity control: reach a target, keep the links off round obstacles."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_integer, require_numbers
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.problem import MOST_COORDINATES
from ocp_torch.problems.systems.linkage import Linkage


class Arm(Linkage):
    r"""A `Linkage` in the plane: `s_i` is the angle of joint `i` against the link before it.

    Joint `i` ends at `r_i = r_{i-1} + l_i (cos, sin)(s_1 + ... + s_i)`, in metres from the base, and the tip is
    `p = r_n` (Murray, Li, Sastry: *A Mathematical Introduction to Robotic Manipulation*, chapter 3). An obstacle costs
    about ``obstacle_weight`` where any part of the arm is inside.

    ``lengths`` in metres, by default 1 / dim each; ``target`` `[x, y]`; ``obstacles`` a list of `[x, y, radius]`. The
    optimal flow contracts onto the configurations that reach the target: `mu*` is declared unbounded, and no `M` makes
    `F_M` a bound, with a control limit or without, as the control is small there. With ``joint_noise``, in rad/sqrt(s) for
    all joints or each, or ``noise`` nothing is known of `mu*`. Raises `InputError` for wrong arguments.
    """

    def __init__(
        self,
        dim: int = 2,
        lengths: list[float] | None = None,
        target: Sequence[float] = (0.2, 0.65),
        obstacles: Sequence[Sequence[float]] = ((0.75, -0.4, 0.08),),
        clearance: float = 0.2,
        target_weight: float = 1.0,
        obstacle_weight: float = 3.0,
        speed: float = 0.35,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: Limit = None,
        joint_noise: float | Sequence[float] = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        joints = require_integer("problem.dim", dim, 1, maximum=MOST_COORDINATES)
        super().__init__(joints, speed, joint_noise, discount, exponent, control_limit, noise)
        self.pursue(2, target, obstacles, clearance, target_weight, obstacle_weight)
        equal = [1.0 / self.dim] * self.dim
        self.lengths = equal if lengths is None else require_numbers("problem.lengths", lengths, self.dim, above=0.0)
        self._lengths = torch.tensor(self.lengths, dtype=torch.float64)
        self.stretch(sum(self.lengths), [0.0, 0.0])

    def joints(self, s: Tensor) -> Tensor:
        """Base, joints and end effector in metres, ``(N, n + 1, 2)``."""
        angle = s.cumsum(dim=-1)
        links = torch.stack([angle.cos(), angle.sin()], dim=-1) * self._like(s, "lengths", self._lengths).unsqueeze(-1)
        return torch.cat([links.new_zeros(len(s), 1, 2), links.cumsum(dim=1)], dim=1)

    def jacobian(self, s: Tensor) -> Tensor:
        joints = self.joints(s)
        lever = joints[:, -1:] - joints[:, :-1]
        return torch.stack([-lever[..., 1], lever[..., 0]], dim=1)
