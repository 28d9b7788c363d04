r"""An arm as its URDF file describes it, under joint-velocity control: bring the tip to a point, past round obstacles."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_integer, require_numbers, shown
from ocp_torch.files.reading import kind, require_file
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.problem import MOST_COORDINATES
from ocp_torch.problems.systems.linkage import Linkage

# Types of joints in a URDF file that this model knows.
TURNING = ("revolute", "continuous")
STIFF = "fixed"
# Bytes of a URDF file, at most; meshes lie in files of their own, and are not read.
LARGEST_URDF = 2**24
# The elbow arm without a file: the place of each joint against the one before, in metres, and its axis.
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
    r"""A `Linkage` in space, with the tip at `p = T_1 R_1(s_1) ... T_n R_n(s_n) T_tip 0` in metres.

    The fixed transforms `T` and rotations `R` about the joints' axes are those that the ``urdf`` file names up to the link
    ``tip`` (null: the last one that turning joints move; without a file, a six-joint elbow arm). Every joint turns all the
    way round: limits of joints are not part of the model. ``obstacles`` are balls `[x, y, z, radius]`, felt ``clearance``
    metres from their surface, along the lines from joint to joint.

    ``chain`` is the kinematics as numbers (`read_chain`), in place of ``urdf``: what a saved controller holds. `mu*` is
    declared unbounded, as for `Arm`, unless there is ``joint_noise``, in rad/sqrt(s), or ``noise``. Raises `InputError` for
    wrong arguments.
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
        control_limit: Limit = None,
        joint_noise: float | Sequence[float] = 0.0,
        noise: float | Sequence[float] = 0.0,
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
        joints = require_integer("the number of joints", len(self.chain) - 1, 1, maximum=MOST_COORDINATES)
        super().__init__(joints, speed, joint_noise, discount, exponent, control_limit, noise)
        self.pursue(3, target, obstacles, clearance, target_weight, obstacle_weight)
        self.urdf, self.tip = None, None  # a saved controller needs no file
        rows = torch.tensor(self.chain, dtype=torch.float64)
        self._fixed, self._axes = rows[:, :12].reshape(-1, 3, 4), rows[:-1, 12:]
        # The cross product with an axis as a matrix: R = I + sin K + (1 - cos) K K (Rodrigues).
        self._turners = torch.linalg.cross(torch.eye(3).double().expand(self.dim, 3, 3), self._axes[:, None], dim=-1)
        steps = self._fixed[:, :, 3]
        self.stretch(float(steps[1:].norm(dim=-1).sum()), steps[0].tolist())

    def _frames(self, s: Tensor) -> tuple[Tensor, list[Tensor]]:
        """The result of `joints`, and the frame that each joint turns in, `n` times ``(N, 3, 3)``."""
        angle = s[..., None, None]
        eye = torch.eye(3, dtype=s.dtype, device=s.device)
        fixed, K = self._like(s, "fixed", self._fixed), self._like(s, "turners", self._turners)
        turns = eye + angle.sin() * K + (1.0 - angle.cos()) * (K @ K)
        rotation, at = eye.expand(len(s), 3, 3), s.new_zeros(len(s), 3)
        points, held = [at], []
        for i in range(self.dim + 1):
            at = at + rotation @ fixed[i, :, 3]
            points.append(at)
            if i < self.dim:
                held.append(rotation @ fixed[i, :, :3])
                rotation = held[-1] @ turns[:, i]
        return torch.stack(points, dim=1), held

    def joints(self, s: Tensor) -> Tensor:
        """The base, each joint and the tip in metres, ``(N, n + 2, 3)``."""
        return self._frames(s)[0]

    def jacobian(self, s: Tensor) -> Tensor:
        joints, held = self._frames(s)
        axes = torch.stack(held, dim=1) @ self._like(s, "axes", self._axes).unsqueeze(-1)
        return torch.linalg.cross(axes.squeeze(-1), joints[:, -1:] - joints[:, 1:-1], dim=-1).mT


def read_chain(path: str | Path, tip: str | None) -> list[list[float]]:
    """The kinematics from the base of a URDF file's robot to the link ``tip``: a row for each turning joint, and one for
    the tip.

    A row is the transform from the joint before, as the 12 numbers of its upper rows, and the axis of the joint (zeros
    for the tip). Without a ``tip``, the link behind the most turning joints, the farthest of them. Limits of joints are left
    out. Raises `InputError` without yourdfpy, for a file that is no URDF, an unknown tip, and joints that slide on the way.
    """
    path = Path(path)
    if kind(path) is None:
        raise InputError(f"problem.urdf is {str(path)!r}, which is not a file.")
    require_file(path, LARGEST_URDF)
    try:
        from yourdfpy import URDF
    except ImportError:
        raise InputError('problem.urdf needs yourdfpy; install it with pip install -e ".[urdf]".') from None
    try:
        nothing = dict.fromkeys(("build_scene_graph", "load_meshes", "build_collision_scene_graph"), False)
        robot = URDF.load(str(path), load_collision_meshes=False, **nothing).robot
    except Exception as error:  # the parsers beneath raise types of their own
        raise InputError(f"problem.urdf = {path} cannot be read as a URDF ({type(error).__name__}).") from None
    above = {joint.child: joint for joint in robot.joints}
    chains = {link.name: _upwards(link.name, above) for link in robot.links}
    usable = {name: chain for name, chain in chains.items() if all(j.type in (*TURNING, STIFF) for j in chain)}
    count = lambda chain: sum(joint.type in TURNING for joint in chain)
    if tip is None:
        tip = max(usable, key=lambda name: (count(usable[name]), len(usable[name])), default=None)
    if tip not in chains:
        raise InputError(f"problem.tip is {tip!r}, but the links of {path} are {', '.join(list(chains)[:40])}.")
    if tip not in usable:
        raise InputError(f"problem.tip is {tip!r}, but a joint on the way there does not turn; take a link before it.")
    if count(usable[tip]) == 0:
        raise InputError(f"problem.tip is {tip!r}, but no joint on the way there turns.")
    return _rows(usable[tip])


def _upwards(link: str, above: dict) -> list:
    """The joints from the base to ``link``."""
    chain, seen = [], set()
    while link in above and link not in seen:
        seen.add(link)
        chain.append(above[link])
        link = above[link].parent
    return chain[::-1]


def _rows(chain: list) -> list[list[float]]:
    rows, transform = [], np.eye(4)
    for joint in chain:
        transform = transform @ (np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=float))
        if joint.type in TURNING:
            axis = np.asarray([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, dtype=float)
            rows.append([*transform[:3].flatten().tolist(), *(axis / np.linalg.norm(axis)).tolist()])
            transform = np.eye(4)
    return [*rows, [*transform[:3].flatten().tolist(), 0.0, 0.0, 0.0]]
