r"""Swing up a double pendulum by a torque at one of its joints: acrobot (elbow) and pendubot (shoulder)."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, nearest, require_number, require_numbers
from ocp_torch.problems.physical.coordinates import Angle, Interval
from ocp_torch.problems.physical.start import Points
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.systems.rest import bound_at_rest

HANGING = (math.pi, 0.0, 0.0, 0.0)
# Spread of the starts around hanging at rest, in rad and rad/s.
HANGING_SPREAD = (0.5, 0.5, 1.0, 1.0)
# Starts anywhere have any angles, and speeds up to this part of ``max_speeds``.
ANYWHERE = 0.3
STARTS = ("anywhere", "hanging")


class DoublePendulum(System):
    r"""`M(theta) theta'' = h(theta, theta') - damping theta' + e_j tau`: two links in the vertical plane, `tau` at joint `j`.

    `theta_1` is the first link's angle from upright, `theta_2` the elbow's from straight, both in rad; velocities in rad/s;
    `tau` in N m within ``control_limit``. `d = 4`, `m = 1`. Cost `2 (1 - cos theta_1) + 2 (1 - cos(theta_1 + theta_2))
    + speed_cost (theta_1'^2 + theta_2'^2) + torque_cost tau^2 / 2`: the goal is upright, with both links vertical.

    Defaults are those identified for the RealAIGym double pendulum, design C.1, model 1.0 (Wiebe, Kumar, Shala, Vyas,
    Javadi, Kirchner: *An Open Source Dual-Purpose Acrobot and Pendubot Platform*, IEEE Robotics and Automation Magazine,
    2023), and its limit of 6 N m; as in the simulation of that benchmark, without Coulomb friction and rotor inertia, but
    with the viscous ``damping`` in N m s/rad. ``masses`` in kg, ``lengths`` in m, ``centres`` of mass in m from the joint,
    ``inertias`` in kg m^2 about the joint.

    The box is ``max_speeds``. ``starts`` is *anywhere* (any angles, speeds up to 0.3 of those) or *hanging* (at rest, with a
    spread of 0.5 rad and 1 rad/s). ``torque_noise`` in N m sqrt(s) enters as the torque does. A2 of the paper fails. Raises
    `InputError` for wrong arguments.
    """

    joint: int  # 0 shoulder, 1 elbow

    def __init__(
        self,
        masses: Sequence[float] = (0.5234602302310271, 0.6255677234174437),
        lengths: Sequence[float] = (0.2, 0.3),
        centres: Sequence[float] = (0.2, 0.25569305436052964),
        inertias: Sequence[float] = (0.031887199591513114, 0.05086984812807257),
        damping: Sequence[float] = (0.001, 0.001),
        gravity: float = 9.81,
        max_speeds: Sequence[float] = (15.0, 25.0),
        speed_cost: float = 0.01,
        torque_cost: float = 0.1,
        starts: str = "anywhere",
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: float | None = 6.0,
        torque_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        pair = lambda name, value: require_numbers(f"problem.{name}", value, 2)
        self.masses, self.lengths = pair("masses", masses), pair("lengths", lengths)
        self._lengths = torch.tensor(self.lengths, dtype=torch.float64).unsqueeze(-1)
        self.centres, self.inertias = pair("centres", centres), pair("inertias", inertias)
        self.damping, self.max_speeds = pair("damping", damping), pair("max_speeds", max_speeds)
        for name in ("masses", "lengths", "centres", "inertias", "max_speeds"):
            for i, value in enumerate(getattr(self, name)):
                require_number(f"problem.{name}[{i}]", value, above=0.0)
        for i, value in enumerate(self.damping):
            require_number(f"problem.damping[{i}]", value, at_least=0.0)
        self.gravity = require_number("problem.gravity", gravity, at_least=0.0)
        self.speed_cost = require_number("problem.speed_cost", speed_cost, at_least=0.0)
        self.torque_cost = require_number("problem.torque_cost", torque_cost, above=0.0)
        self.torque_noise = require_number("problem.torque_noise", torque_noise, at_least=0.0)
        if starts not in STARTS:
            raise InputError(
                f"problem.starts is {starts!r}, but must be {' or '.join(STARTS)}{nearest(str(starts), STARTS)}."
            )
        names = ("shoulder", "elbow")
        speeds = [Interval(f"{n} speed", -v, v, "rad/s") for n, v in zip(names, self.max_speeds, strict=True)]
        slow = {c.name: (ANYWHERE * c.low, ANYWHERE * c.high) for c in speeds}
        self.starts = starts
        super().__init__(
            [*(Angle(name) for name in names), *speeds],
            [f"{names[self.joint]} torque [N m]"],
            discount,
            exponent,
            control_weight=self.torque_cost,
            control_limit=control_limit,
            start=slow if starts == "anywhere" else Points([HANGING], HANGING_SPREAD),
            noise=noise,
        )
        self._set_constants()
        seams = [0.5 * c.length for c in speeds]
        self.state_cost_bound = 8.0 + self.speed_cost * sum(v**2 for v in seams)
        self.occupation_bound = bound_at_rest(self, [0.0] * 4)

    def _set_constants(self) -> None:
        (m1, m2), (l1, _), (r1, r2), (I1, I2) = self.masses, self.lengths, self.centres, self.inertias
        self._total, self._outer, self._coupling = I1 + I2 + m2 * l1**2, I2, m2 * l1 * r2
        self._weights = self.gravity * (m1 * r1 + m2 * l1), self.gravity * m2 * r2
        if self._outer * (self._total - self._outer) <= self._coupling**2:
            raise InputError(
                f"problem.inertias are {self.inertias}, but must be about the joints, at least a mass times the square of "
                "its centre's distance."
            )

    def mass_matrix(self, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`M_11`, `M_12` and `M_22`, in kg m^2."""
        bend = self._coupling * s[:, 1].cos()
        return self._total + 2.0 * bend, self._outer + bend, torch.full_like(bend, self._outer)

    def energy(self, s: Tensor) -> Tensor:
        """Kinetic plus potential energy in J, ``(N,)``; the latter is 0 with both links level."""
        (m11, m12, m22), (w1, w2) = self.mass_matrix(s), s[:, 2:].unbind(-1)
        kinetic = 0.5 * (m11 * w1.square() + 2.0 * m12 * w1 * w2 + m22 * w2.square())
        return kinetic + self._weights[0] * s[:, 0].cos() + self._weights[1] * (s[:, 0] + s[:, 1]).cos()

    def cost(self, s: Tensor) -> Tensor:
        # 2 (1 - cos) as 4 sin^2 of the half angle loses no digits near upright.
        tilts = torch.stack([s[:, 0], s[:, 0] + s[:, 1]], dim=-1)
        return 4.0 * (0.5 * tilts).sin().square().sum(dim=-1) + self.speed_cost * s[:, 2:].square().sum(dim=-1)

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        t1, t2, w1, w2 = s.unbind(-1)
        m11, m12, m22 = self.mass_matrix(s)
        bent, fallen = self._coupling * t2.sin(), self._weights[1] * (t1 + t2).sin()
        force1 = bent * (2.0 * w1 + w2) * w2 + self._weights[0] * t1.sin() + fallen - self.damping[0] * w1
        force2 = -bent * w1.square() + fallen - self.damping[1] * w2
        det = m11 * m22 - m12.square()
        a = torch.stack([w1, w2, (m22 * force1 - m12 * force2) / det, (m11 * force2 - m12 * force1) / det], dim=-1)
        column = (m22, -m12) if self.joint == 0 else (-m12, m11)
        still = torch.zeros_like(det)
        return a, torch.stack([still, still, column[0] / det, column[1] / det], dim=-1).unsqueeze(-1)

    def disturbance(self, s: Tensor) -> Tensor | None:
        return self.torque_noise * self.dynamics(s)[1] if self.torque_noise else None

    def joints(self, s: Tensor) -> Tensor:
        """Shoulder, elbow and tip in m, up positive, ``(N, 3, 2)``."""
        angles = torch.stack([s[:, 0], s[:, 0] + s[:, 1]], dim=-1)
        links = torch.stack([-angles.sin(), angles.cos()], dim=-1) * self._like(s, "lengths", self._lengths)
        return torch.cat([torch.zeros_like(links[:, :1]), links.cumsum(dim=1)], dim=1)


class Acrobot(DoublePendulum):
    """The torque is at the elbow (Murray and Hauser, 1991)."""

    joint = 1
    gymnasium = "Acrobot-v1"

    def observed(self, observation: np.ndarray) -> np.ndarray:
        """The physical state ``(4,)`` of an observation, whose angles are from hanging."""
        c1, s1, c2, s2, w1, w2 = observation
        return np.array([np.arctan2(-s1, -c1), np.arctan2(s2, c2), w1, w2])

    def action(self, control: np.ndarray) -> np.ndarray:
        """The number of the nearest of the environment's torques, -1, 0 and 1 N m."""
        return np.array(np.rint(control[0]).clip(-1.0, 1.0) + 1.0, dtype=np.int64)


class Pendubot(DoublePendulum):
    """The torque is at the shoulder (Spong and Block, 1995)."""

    joint = 0
