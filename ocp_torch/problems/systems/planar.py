r"""The base class of vehicles in the plane: position and heading, a target, round obstacles, and walls on request."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_number
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.coordinates import Angle, Coordinate, Interval
from ocp_torch.problems.physical.units import TURN
from ocp_torch.problems.systems.reaching import Reaching, bump

# Starts are in this part of a room, along each axis: a vehicle that cannot stop needs room to turn away from a wall.
INNER = 0.7


class PlanarVehicle(Reaching):
    r"""State `(x, y, heading)`, in m and rad: in a plane that repeats itself after ``size`` metres, or with ``walls`` in a
    room, `[0, size]^2`.

    `cost = target_weight r^2 + obstacle_weight sum_o b_o`, with the smooth periodic distance `r^2 = (size/pi)^2 (sin^2 pi(x -
    g_1)/size + sin^2 pi(y - g_2)/size)` from the target `g`, in a room Euclid's, and bumps `b_o` that are 1 at the centre of
    an obstacle and 0 from ``clearance`` metres outside its rim on. To leave the room, in whose inner part it starts, is
    a failure that costs ``failure_cost`` for ever, by default the largest cost in it.
    """

    # The direction ahead does not depend on the position, nor the turn on the heading.
    divergence_free = True

    def __init__(
        self,
        controls: Sequence[str],
        size: float,
        speed: float,
        turn_rate: float,
        walls: bool,
        failure_cost: float | None,
        discount: float,
        exponent: float,
        control_limit: Limit,
        heading_noise: float,
        position_noise: float,
        noise: float | Sequence[float],
    ) -> None:
        """``controls`` are speed and turn rate or the latter alone, in units of ``speed`` m/s and ``turn_rate`` turns/s.
        ``heading_noise`` is in rad/sqrt(s), ``position_noise`` in m/sqrt(s) along each axis. Call `pursue` before."""
        self.size = require_number("problem.size", size, above=0.0)
        self.speed = require_number("problem.speed", speed, above=0.0)
        self.turn_rate = require_number("problem.turn_rate", turn_rate, above=0.0)
        self.walls = require_flag("problem.walls", walls)
        nominal = [self.speed, TURN * self.turn_rate][-len(controls) :]
        along = lambda name: Interval(name, 0, self.size, "m") if self.walls else Angle(name, self.size, "m", 0.0)
        box: list[Coordinate] = [along("x"), along("y"), Angle("heading")]
        inner = tuple(0.5 * self.size * (1.0 + side * INNER) for side in (-1, 1))
        start = {"x": inner, "y": inner} if self.walls else None
        super().__init__(
            box, controls, discount, exponent, 1.0, control_limit, start, noise, failure_cost, nominal_control=nominal
        )
        if not self.walls and failure_cost is not None:
            raise InputError(f"problem.failure_cost is {failure_cost:g}, but nothing fails without problem.walls=true.")
        if self.walls and not all(0.0 <= g <= self.size for g in self.target):
            raise InputError(f"problem.target is {self.target}, but must be in the room, from 0 to {self.size:g} m.")
        # From the target to the farther seams.
        reach = [max(g, self.size - g) + 0.5 * (box[0].length - self.size) for g in self.target]
        self.bound_cost(math.hypot(*reach) ** 2 if self.walls else 2.0 * (self.size / math.pi) ** 2)
        self.heading_noise = require_number("problem.heading_noise", heading_noise, at_least=0.0)
        self.position_noise = require_number("problem.position_noise", position_noise, at_least=0.0)
        each = [self.position_noise, self.position_noise, self.heading_noise]
        self.disturb(torch.tensor(each, dtype=torch.float64).diag())

    def heading(self, s: Tensor) -> Tensor:
        """The unit vector ahead, ``(N, 2)``."""
        return torch.stack([s[:, 2].cos(), s[:, 2].sin()], dim=-1)

    def moves(self, s: Tensor) -> Tensor:
        """The velocities of the state at a speed of 1 m/s and at a turn rate of 1 rad/s, as columns ``(N, 3, 2)``."""
        cos, sin, still = s[:, 2].cos(), s[:, 2].sin(), torch.zeros_like(s[:, 2])
        return torch.stack([cos, still, sin, still, still, still + 1.0], dim=-1).unflatten(1, (3, 2))

    def _offsets(self, s: Tensor, points: Tensor) -> Tensor:
        """The shortest way to ``points`` ``(k, 2)``, in metres, ``(N, k, 2)``."""
        off = points - s[:, None, :2]
        return off if self.walls else (off + 0.5 * self.size).remainder(self.size) - 0.5 * self.size

    def _square_distances(self, s: Tensor, points: Tensor) -> Tensor:
        """`r^2` from ``points`` ``(k, 2)``, ``(N, k)``."""
        off, wave = points - s[:, None, :2], math.pi / self.size
        return (off if self.walls else (wave * off).sin() / wave).square().sum(dim=-1)

    def to_target(self, x: Tensor) -> Tensor:
        return self._offsets(self.from_torus(x), self._like(x, "target", self._target).unsqueeze(0))[:, 0]

    def gaps(self, x: Tensor, balls: Tensor) -> Tensor:
        return self._offsets(self.from_torus(x), balls[:, :2]).norm(dim=-1) - balls[:, 2]

    def cost(self, s: Tensor) -> Tensor:
        target, discs = self._like(s, "target", self._target), self._like(s, "balls", self._balls)
        bumps = bump(self._square_distances(s, discs[:, :2]), discs[:, 2] + self.clearance)
        away = self._square_distances(s, target.unsqueeze(0))[:, 0]
        return self.target_weight * away + self.obstacle_weight * bumps.sum(dim=-1)
