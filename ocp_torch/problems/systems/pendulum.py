r"""Swing up a pendulum by a torque at its pivot: the model and parameters of Gymnasium's Pendulum-v1, made periodic."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_number
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.coordinates import Angle, Interval
from ocp_torch.problems.physical.prices import scaled_limit
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.rest import bound_at_rest

SPEED_COST = 0.1


class Pendulum(System):
    r"""`theta'' = 3 g / (2 l) sin(theta) + 3 / (m l^2) tau`, upright at 0; `x_1 = theta / 2 pi`, `x_2 = theta' / (2 W)`.

    Cost `f = s (2 (1 - cos theta) + 0.1 c(theta'))` and `s torque_cost tau^2 = |u|^2 / 2` with `tau = max_torque u` and
    `s = 1 / (2 torque_cost max_torque^2)`: Gymnasium's `theta^2 + 0.1 theta'^2 + 0.001 tau^2`, times `s`, with `theta^2` made
    smooth at the bottom (it agrees to second order upright), and with a torque cost of its own, since without a limit on
    the torque Gymnasium's 0.001 makes it all but free. With ``square_cost``, which is `theta^2` with its kink at the bottom,
    `torque_cost = 0.001` and a control limit of 1 the two agree.

    The box is `|theta'| <= max_speed`, with the seam at ``seam`` `= W` rad/s; `c` is `theta'^2` in it and flattens beyond
    (where Gymnasium clips the speed), and the path in phase space stays the same. It starts everywhere, also beyond. `d = 2`,
    `m = 1`; angles in radians, velocities in rad/s, torque in N m, mass in kg, length in m. A2 of the paper fails: the angle
    is not controlled directly. ``torque_noise`` in N m sqrt(s) enters as the torque does, cut off like it, so that it does
    not cross the seam either; ``noise``, of both coordinates, does. With either nothing is known of `mu*`. Raises
    `InputError` for wrong arguments.
    """

    gymnasium = "Pendulum-v1"
    initial_density = Problem.initial_density
    divergence_free = True

    def __init__(
        self,
        gravity: float = 10.0,
        mass: float = 1.0,
        length: float = 1.0,
        max_speed: float = 8.0,
        seam: float = 10.0,
        max_torque: float = 2.0,
        torque_cost: float = 0.1,
        square_cost: bool = False,
        discount: float = 2.0,
        exponent: float = 2.0,
        control_limit: Limit = None,
        torque_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.gravity = require_number("problem.gravity", gravity, at_least=0.0)
        self.mass = require_number("problem.mass", mass, above=0.0)
        self.length = require_number("problem.length", length, above=0.0)
        self.max_speed = require_number("problem.max_speed", max_speed, above=0.0)
        self.seam = require_number("problem.seam", seam, above=0.0)
        if self.seam <= self.max_speed:
            raise InputError(
                f"problem.seam is {self.seam:g}, but must be above problem.max_speed = {self.max_speed:g}, where the "
                "velocity starts to be cut off."
            )
        self.max_torque = require_number("problem.max_torque", max_torque, above=0.0)
        q = require_number("problem.exponent", exponent, above=1.0, at_most=2.0)
        margin = 0.5 * (self.seam - self.max_speed) / self.max_speed
        super().__init__(
            [Angle("angle"), Interval("velocity", -self.max_speed, self.max_speed, "rad/s", margin)],
            ["torque [N m]"],
            discount,
            q,
            control_weight=self.max_torque**-q,
            control_limit=scaled_limit(control_limit, [self.max_torque]),
            noise=noise,
        )
        self.torque_cost = require_number("problem.torque_cost", torque_cost, above=0.0)
        self.square_cost = require_flag("problem.square_cost", square_cost)
        self.torque_noise = require_number("problem.torque_noise", torque_noise, at_least=0.0)
        self._pull = 1.5 * self.gravity / self.length
        self._pushed = torch.tensor([[0.0], [3.0 / (self.mass * self.length**2)]], dtype=torch.float64)
        self.disturb(self.torque_noise * self._pushed)
        self._scale = 0.5 / (self.torque_cost * self.max_torque**2)
        self._square_at_seam = float(self._square(torch.tensor(self.seam, dtype=torch.float64)))
        largest = math.pi**2 if self.square_cost else 4.0
        self.state_cost_bound = self._scale * (largest + SPEED_COST * self._square_at_seam)
        self.occupation_bound = bound_at_rest(self, [0.0, 0.0])

    def _square(self, velocity: Tensor) -> Tensor:
        """`c = 2 int_0^v |v| chi dv`: `v^2` up to ``max_speed``, level at the seam."""
        width = self.seam - self.max_speed
        z = ((velocity.abs() - self.max_speed) / width).clamp(0.0, 1.0)
        level = z - 2.5 * z**4 + 3.0 * z**5 - z**6
        slope = 0.5 * z**2 - 2.0 * z**5 + 2.5 * z**6 - 6.0 / 7.0 * z**7
        return velocity.clamp(-self.max_speed, self.max_speed) ** 2 + 2.0 * width * (
            self.max_speed * level + width * slope
        )

    def cost(self, s: Tensor) -> Tensor:
        angle = s[:, 0]
        # 2 (1 - cos) as 4 sin^2 of the half angle loses no digits near upright.
        tilt = angle.square() if self.square_cost else 4.0 * (0.5 * angle).sin().square()
        return self._scale * (tilt + SPEED_COST * self._square(s[:, 1]))

    def state_cost(self, x: Tensor) -> Tensor:
        """`cost` also beyond ``max_speed``, without a failure cost: it is level at the seam already."""
        return self.cost(self.from_torus(x))

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        angle, velocity = s.unbind(-1)
        a = torch.stack([velocity, self._pull * angle.sin()], dim=-1)
        return a, self._like(s, "pushed", self._pushed).expand(len(s), 2, 1)

    def observed(self, observation: np.ndarray) -> np.ndarray:
        cosine, sine, velocity = observation
        return np.array([np.arctan2(sine, cosine), velocity])

    def action(self, control: np.ndarray) -> np.ndarray:
        return np.clip(control, -self.max_torque, self.max_torque)
