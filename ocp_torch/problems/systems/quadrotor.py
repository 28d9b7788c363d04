r"""A quadrotor in a vertical plane: fly to a place in a room, past round obstacles, by two thrusts."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_number, require_numbers
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.coordinates import Interval
from ocp_torch.problems.systems.reaching import Reaching, bump
from ocp_torch.problems.systems.rest import bound_at_rest

# Starts are in this part of the room, along each axis,
INNER = 0.7
# and in this part of the box's pitch and speeds.
SLOW = 0.3
LIMITS = [1.0, 1.0]  # N


class Quadrotor(Reaching):
    r"""`x'' = -T sin(pitch) / m`, `z'' = T cos(pitch) / m - g`, `pitch'' = arm (u_2 - u_1) / J`, `T = m g + u_1 + u_2`.

    The thrusts of its left and right rotors are `m g / 2 + u_i`: `u = 0` hovers. `d = 6`, `m = 2`; `x`, `z` in m, pitch in
    rad, `u_i` in N within ``control_limit``. Mass, arm and inertia are those of the planar quadrotor of
    *Underactuated Robotics* (Tedrake), from Bouadi, Bouchoucha and Tadjine (2007). Cost `target_weight |(x, z) - target|^2
    + obstacle_weight sum_o b_o + pitch_cost 2 (1 - cos pitch) + speed_cost (x'^2 + z'^2 + (arm pitch')^2)
    + thrust_cost |u|^2 / 2`, with bumps `b_o` that are 1 at the centre of an obstacle and 0 from ``clearance`` metres outside
    its rim on.

    The box is the room of half-width ``width`` and of ``height``, ``max_pitch``, and ``max_speeds`` of `x`, `z` (m/s) and
    pitch (rad/s): leaving it is a crash. ``thrust_noise`` in N sqrt(s) enters as each thrust does. A2 of the paper fails.
    Raises `InputError` for wrong arguments.
    """

    def __init__(
        self,
        mass: float = 0.486,
        arm: float = 0.25,
        inertia: float = 0.00383,
        gravity: float = 9.81,
        width: float = 2.0,
        height: float = 3.0,
        max_pitch: float = 1.2,
        max_speeds: Sequence[float] = (3.0, 3.0, 8.0),
        target: Sequence[float] = (0.0, 1.5),
        obstacles: Sequence[Sequence[float]] = ((0.9, 1.0, 0.25),),
        clearance: float = 0.3,
        target_weight: float = 1.0,
        obstacle_weight: float = 4.0,
        pitch_cost: float = 0.2,
        speed_cost: float = 0.1,
        thrust_cost: float = 1.0,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: Limit = LIMITS,
        thrust_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        positive = lambda name, value: require_number(f"problem.{name}", value, above=0.0)
        weight = lambda name, value: require_number(f"problem.{name}", value, at_least=0.0)
        self.mass, self.arm, self.inertia = positive("mass", mass), positive("arm", arm), positive("inertia", inertia)
        self.width, self.height = positive("width", width), positive("height", height)
        self.gravity, self.max_pitch = weight("gravity", gravity), positive("max_pitch", max_pitch)
        self.pitch_cost, self.speed_cost = weight("pitch_cost", pitch_cost), weight("speed_cost", speed_cost)
        self.thrust_cost, self.thrust_noise = positive("thrust_cost", thrust_cost), weight("thrust_noise", thrust_noise)
        self.max_speeds = require_numbers("problem.max_speeds", max_speeds, 3)
        for i, value in enumerate(self.max_speeds):
            require_number(f"problem.max_speeds[{i}]", value, above=0.0)
        self.pursue(2, target, obstacles, clearance, target_weight, obstacle_weight)
        named = zip(("x speed", "z speed", "pitch rate"), self.max_speeds, ("m/s", "m/s", "rad/s"), strict=True)
        self.room = [Interval("x", -self.width, self.width, "m"), Interval("z", 0.0, self.height, "m")]
        tilts = [Interval("pitch", -self.max_pitch, self.max_pitch, "rad")]
        tilts += [Interval(name, -top, top, unit) for name, top, unit in named]
        part = lambda c, share: (c.centre + share * (c.low - c.centre), c.centre + share * (c.high - c.centre))
        start = {**{c.name: part(c, INNER) for c in self.room}, **{c.name: part(c, SLOW) for c in tilts}}
        super().__init__(
            [*self.room, *tilts],
            ["left thrust [N]", "right thrust [N]"],
            discount,
            exponent,
            control_weight=self.thrust_cost,
            control_limit=control_limit,
            start=start,
            noise=noise,
        )
        seams = torch.tensor([[c.centre + side * c.length for c in self.coordinates] for side in (-0.5, 0.5)]).double()
        far = torch.where((seams[0] - self._goal).abs() > (seams[1] - self._goal).abs(), seams[0], seams[1])
        bumps = self.obstacle_weight * len(self.obstacles)
        self.state_cost_bound = max(float(self._smooth(far[None])) + bumps, self._failure)
        self.occupation_bound = bound_at_rest(self, self._goal.tolist())

    @property
    def _goal(self) -> Tensor:
        """The state of hovering at the target."""
        return torch.tensor([*self.target, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)

    def _smooth(self, s: Tensor) -> Tensor:
        """The cost without obstacles, ``(N,)``."""
        way = (s[:, :2] - self._like(s, "target", self._target)).square().sum(dim=-1)
        tilt = 4.0 * (0.5 * s[:, 2]).sin().square()
        speed = s[:, 3:5].square().sum(dim=-1) + (self.arm * s[:, 5]).square()
        return self.target_weight * way + self.pitch_cost * tilt + self.speed_cost * speed

    def cost(self, s: Tensor) -> Tensor:
        balls = self._like(s, "balls", self._balls)
        square = (s[:, None, :2] - balls[:, :2]).square().sum(dim=-1)
        return self._smooth(s) + self.obstacle_weight * bump(square, balls[:, 2] + self.clearance).sum(dim=-1)

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        sin, cos = s[:, 2].sin(), s[:, 2].cos()
        still = torch.zeros_like(sin)
        a = torch.stack([s[:, 3], s[:, 4], s[:, 5], -self.gravity * sin, self.gravity * (cos - 1.0), still], dim=-1)
        turn = torch.full_like(sin, self.arm / self.inertia)
        columns = [
            torch.stack([still, still, still, -sin / self.mass, cos / self.mass, side * turn], dim=-1)
            for side in (-1, 1)
        ]
        return a, torch.stack(columns, dim=-1)

    def disturbance(self, s: Tensor) -> Tensor | None:
        return self.thrust_noise * self.dynamics(s)[1] if self.thrust_noise else None

    def to_target(self, x: Tensor) -> Tensor:
        return self._like(x, "target", self._target) - self.from_torus(x)[:, :2]

    def gaps(self, x: Tensor, balls: Tensor) -> Tensor:
        return (self.from_torus(x)[:, None, :2] - balls[:, :2]).norm(dim=-1) - balls[:, 2]
