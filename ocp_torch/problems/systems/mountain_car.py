r"""A car in a valley, too weak to drive straight up the hill: it has to gather speed first; d = 2, one force."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.problems.physical.chart import smooth_step
from ocp_torch.problems.physical.coordinates import Interval
from ocp_torch.problems.physical.start import Start
from ocp_torch.problems.physical.system import System

# How often the hills of Moore's landscape, sin(3 p), repeat in 2 pi.
HILLS = 3.0


class MountainCar(System):
    r"""`p'' = power u - gravity cos(3 p)` until the car is at the ``goal``; `|u| <= 1`.

    The task of Moore (*Efficient memory-based learning for robot control*, 1990) in the units of Gymnasium's
    MountainCarContinuous-v0: time is in steps of that environment, position and velocity are without units. Cost: ``effort``
    `u^2` for the force, 0.1 there, and ``time_cost`` per step, until the goal is reached. The box is ``low`` to ``high`` and
    ``max_velocity`` either way; from the goal to ``high`` motion and cost come to an end. Where that environment has a wall
    and a largest speed, the car fails here: it stops, and goes on to pay for its time.

    What arrives stays, so that `mu*` is unbounded without noise. ``force_noise`` in units of the force times the square root
    of a step enters as the force does. Raises `InputError` for wrong arguments.
    """

    gymnasium = "MountainCarContinuous-v0"

    def __init__(
        self,
        power: float = 0.0015,
        gravity: float = 0.0025,
        low: float = -1.2,
        goal: float = 0.45,
        high: float = 0.6,
        max_velocity: float = 0.07,
        time_cost: float = 0.05,
        effort: float = 0.1,
        start: Start = None,
        discount: float = 0.005,
        exponent: float = 2.0,
        control_limit: float | Sequence[float] | None = 1.0,
        force_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.power = require_number("problem.power", power, above=0.0)
        self.gravity = require_number("problem.gravity", gravity, at_least=0.0)
        self.time_cost = require_number("problem.time_cost", time_cost, above=0.0)
        self.effort = require_number("problem.effort", effort, above=0.0)
        self.force_noise = require_number("problem.force_noise", force_noise, at_least=0.0)
        self.low = require_number("problem.low", low)
        self.goal = require_number("problem.goal", goal, above=self.low)
        self.high = require_number("problem.high", high, above=self.goal)
        self.max_velocity = require_number("problem.max_velocity", max_velocity, above=0.0)
        super().__init__(
            [Interval("position", low, high), Interval("velocity", -max_velocity, max_velocity)],
            ["force"],
            discount,
            exponent,
            control_weight=exponent * self.effort,
            control_limit=control_limit,
            start=start,
            noise=noise,
            failure_cost=self.time_cost,
        )
        self._pushed = torch.tensor([[0.0], [self.power]], dtype=torch.float64)
        self.state_cost_bound = self.time_cost
        self.occupation_bound = None if self.noisy else math.inf

    def underway(self, s: Tensor) -> Tensor:
        """The factor of motion and cost at physical states, ``(N,)``: 1 before the goal, 0 from ``high`` on."""
        return smooth_step((s[:, 0] - self.goal) / (self.high - self.goal))

    def cost(self, s: Tensor) -> Tensor:
        return self.time_cost * self.underway(s)

    def arrived(self, x: Tensor) -> Tensor:
        """Whether states ``(N, d)`` of the torus are at the goal, ``(N,)``."""
        return self.from_torus(x)[:, 0] >= self.goal

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        left = self.underway(s)
        a = torch.stack([s[:, 1], -self.gravity * (HILLS * s[:, 0]).cos()], dim=-1) * left.unsqueeze(-1)
        return a, left[:, None, None] * self._like(s, "pushed", self._pushed)

    def disturbance(self, s: Tensor) -> Tensor | None:
        return self.force_noise * self.dynamics(s)[1] if self.force_noise else None

    def energy(self, s: Tensor) -> Tensor:
        """Kinetic plus potential energy ``(N,)``, which only the force changes."""
        return 0.5 * s[:, 1] ** 2 + self.gravity / HILLS * (HILLS * s[:, 0]).sin()

    def observed(self, observation: np.ndarray) -> np.ndarray:
        return observation

    def action(self, control: np.ndarray) -> np.ndarray:
        return control
