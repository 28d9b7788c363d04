r"""Swing up a pendulum by a torque at its pivot: the model and parameters of Gymnasium's Pendulum-v1, made periodic."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.angles import TURN, to_radians, to_turns
from ocp_torch.problems.systems.rest import occupation_bound_at_rest

SPEED_COST = 0.1
# The environment this is a model of: it observes cos theta, sin theta and theta', and takes a torque in N m.
GYMNASIUM = "Pendulum-v1"


class Pendulum(Problem):
    r"""`theta'' = 3 g / (2 l) sin(theta) + 3 / (m l^2) tau`, upright at 0; `x_1 = theta / 2 pi`, `x_2 = theta' / (2 W)`.

    Cost `f = s (2 (1 - cos theta) + 0.1 c(theta'))` and `s torque_cost tau^2 = |u|^2 / 2` with `tau = max_torque u` and
    `s = 1 / (2 torque_cost max_torque^2)`: Gymnasium's `theta^2 + 0.1 theta'^2 + 0.001 tau^2`, times `s`, with `theta^2` made
    smooth at the bottom (it agrees to second order upright), and with a torque cost of its own, since without a limit on
    the torque Gymnasium's 0.001 makes it all but free. With `torque_cost = 0.001` and a control limit of 1 the two agree.

    The velocity is made periodic by a cut-off `chi`: 1 up to ``max_speed`` rad/s, 0 at ``seam`` `= W`, twice differentiable.
    `dx/dt = chi (theta' / 2 pi, theta'' / 2 W)`, and `c` is `theta'^2` up to ``max_speed`` and flattens beyond. The model is
    faithful for `|theta'| <= max_speed`; beyond (where Gymnasium clips the speed) the path in phase space is the same,
    but time slows down until it stands still at the seam, which is never crossed. `d = 2`, `m = 1`; angles in radians,
    velocities in rad/s, torque in N m, mass in kg, length in m. A2 of the paper fails: the angle is not controlled directly.
    ``torque_noise`` in N m sqrt(s) enters as the torque does, cut off like it, so that it does not cross the seam either;
    ``noise``, of both coordinates, does. With either nothing is known of `mu*`. Raises `InputError` for wrong arguments.
    """

    def __init__(
        self,
        gravity: float = 10.0,
        mass: float = 1.0,
        length: float = 1.0,
        max_speed: float = 8.0,
        seam: float = 10.0,
        max_torque: float = 2.0,
        torque_cost: float = 0.1,
        discount: float = 2.0,
        exponent: float = 2.0,
        control_limit: Limit = None,
        torque_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        super().__init__(2, 1, discount, exponent, control_limit, noise)
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
        self.torque_cost = require_number("problem.torque_cost", torque_cost, above=0.0)
        self.torque_noise = require_number("problem.torque_noise", torque_noise, at_least=0.0)
        self._pull = 1.5 * self.gravity / self.length
        self._push = 3.0 * self.max_torque / (self.mass * self.length**2)
        self._scale = 0.5 / (self.torque_cost * self.max_torque**2)
        self._square_at_seam = float(self._square(torch.tensor(self.seam, dtype=torch.float64)))
        self.state_cost_bound = self._scale * (4.0 + SPEED_COST * self._square_at_seam)
        A = torch.tensor([[0.0, 2.0 * self.seam / TURN], [self._pull * TURN / (2.0 * self.seam), 0.0]]).double()
        B = torch.tensor([[0.0], [self._push / (2.0 * self.seam)]], dtype=torch.float64)
        Q = 2.0 * self._scale * torch.tensor([TURN**2, SPEED_COST * (2.0 * self.seam) ** 2], dtype=torch.float64).diag()
        # Noise shakes it at the state of rest too.
        at_rest = None if self.noisy else occupation_bound_at_rest(A, B, Q, self.discount, self.exponent)
        self.occupation_bound = at_rest

    def _velocity(self, x: Tensor) -> Tensor:
        """`theta'` in [-seam, seam) rad/s, ``(N,)``."""
        return ((x[:, 1] + 0.5).remainder(1.0) - 0.5) * (2.0 * self.seam)

    def _beyond(self, velocity: Tensor) -> Tensor:
        """How far the speed is between ``max_speed`` and the seam, in [0, 1]."""
        return ((velocity.abs() - self.max_speed) / (self.seam - self.max_speed)).clamp(0.0, 1.0)

    def _cut(self, velocity: Tensor) -> Tensor:
        z = self._beyond(velocity)
        return 1.0 - z**3 * (10.0 - 15.0 * z + 6.0 * z**2)

    def _cut_slope(self, velocity: Tensor) -> Tensor:
        """`d chi / d theta'`."""
        z = self._beyond(velocity)
        return -30.0 * (z * (1.0 - z)).square() * velocity.sign() / (self.seam - self.max_speed)

    def _cut_bend(self, velocity: Tensor) -> Tensor:
        """The second derivative of `chi`."""
        z = self._beyond(velocity)
        return -60.0 * z * (1.0 - z) * (1.0 - 2.0 * z) / (self.seam - self.max_speed) ** 2

    def _square(self, velocity: Tensor) -> Tensor:
        """`c = 2 int_0^v |v| chi dv`: `v^2` up to ``max_speed``, level at the seam."""
        z, width = self._beyond(velocity), self.seam - self.max_speed
        level = z - 2.5 * z**4 + 3.0 * z**5 - z**6
        slope = 0.5 * z**2 - 2.0 * z**5 + 2.5 * z**6 - 6.0 / 7.0 * z**7
        return velocity.abs().clamp_max(self.max_speed) ** 2 + 2.0 * width * (self.max_speed * level + width * slope)

    def state_cost(self, x: Tensor) -> Tensor:
        # 2 (1 - cos) as 4 sin^2 of the half angle loses no digits near upright.
        tilt = 4.0 * (0.5 * TURN * x[:, 0]).sin().square()
        return self._scale * (tilt + SPEED_COST * self._square(self._velocity(x)))

    def drift(self, x: Tensor) -> Tensor:
        velocity, fall = self._velocity(x), self._pull * (TURN * x[:, 0]).sin()
        return self._cut(velocity).unsqueeze(-1) * torch.stack([velocity / TURN, fall / (2.0 * self.seam)], dim=-1)

    def drift_divergence(self, x: Tensor) -> Tensor:
        """The pendulum keeps volume; only the cut-off does not."""
        return self._cut_slope(self._velocity(x)) * self._pull * (TURN * x[:, 0]).sin()

    def control_matrix(self, x: Tensor) -> Tensor:
        push = self._cut(self._velocity(x)) * self._push / (2.0 * self.seam)
        return torch.stack([torch.zeros_like(push), push], dim=-1).unsqueeze(-1)

    def control_divergence(self, x: Tensor) -> Tensor:
        return (self._cut_slope(self._velocity(x)) * self._push).unsqueeze(-1)

    @property
    def _jolt(self) -> float:
        """`sigma` of the torque noise in the second coordinate, where nothing is cut off."""
        return self._push / self.max_torque * self.torque_noise / (2.0 * self.seam)

    def noise(self, x: Tensor) -> Tensor | None:
        even = super().noise(x)
        if self.torque_noise == 0.0:
            return even
        jolt = self._jolt * self._cut(self._velocity(x))
        column = torch.stack([torch.zeros_like(jolt), jolt], dim=-1).unsqueeze(-1)
        return column if even is None else torch.cat([even, column], dim=-1)

    def noise_divergences(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Of `D_22 = jolt^2 chi^2 / 2`, the part that varies."""
        velocity, stretch = self._velocity(x), 2.0 * self.seam
        cut, slope, bend = self._cut(velocity), self._cut_slope(velocity), self._cut_bend(velocity)
        first = self._jolt**2 * stretch * cut * slope
        second = self._jolt**2 * stretch**2 * (slope.square() + cut * bend)
        return torch.stack([torch.zeros_like(first), first], dim=-1), second

    def to_torus(self, physical: Tensor) -> Tensor:
        """Angles in radians and velocities in rad/s ``(N, 2)`` as states; raises `InputError` for a speed beyond the seam."""
        if bool((physical[:, 1].abs() > self.seam).any()):
            fastest = float(physical[:, 1].abs().max())
            raise InputError(f"the speed {fastest:g} rad/s is beyond the seam of the model at {self.seam:g}.")
        velocity = (physical[:, 1:] / (2.0 * self.seam)).remainder(1.0)
        return torch.cat([to_turns(physical[:, :1]), velocity], dim=-1)

    def from_torus(self, x: Tensor) -> Tensor:
        """States as angles in [-pi, pi) radians, 0 upright, and velocities in [-seam, seam) rad/s, ``(N, 2)``."""
        return torch.stack([to_radians(x[:, 0]), self._velocity(x)], dim=-1)

    def from_observation(self, env: str, observation: np.ndarray) -> np.ndarray:
        """The state of Pendulum-v1 that shows `(cos theta, sin theta, theta')`; speeds beyond the seam are taken at it."""
        if env != GYMNASIUM:
            return super().from_observation(env, observation)
        cosine, sine, velocity = np.asarray(observation, dtype=np.float64)
        physical = [[np.arctan2(sine, cosine), np.clip(velocity, -self.seam, self.seam)]]
        return self.to_torus(torch.tensor(physical, dtype=torch.float64))[0].numpy()

    def to_action(self, env: str, control: np.ndarray) -> np.ndarray:
        """The torque in N m, within the ``max_torque`` that Pendulum-v1 allows."""
        if env != GYMNASIUM:
            return super().to_action(env, control)
        return np.clip(self.max_torque * np.asarray(control), -self.max_torque, self.max_torque)
