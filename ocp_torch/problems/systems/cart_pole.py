r"""Swing up a pole that hangs from a cart by pushing the cart, whose track is short: d = 4, one force."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.problems.physical.coordinates import Angle, Interval
from ocp_torch.problems.physical.start import Start
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.systems.rest import bound_at_rest


class CartPole(System):
    r"""A uniform rod of mass `m` and length `2 l` on a cart of mass `M`, upright at 0, pushed by the force `F`:

        theta'' = (g sin - cos t) / (l (4/3 - m cos^2 / (M + m))),   p'' = t - m l cos theta'' / (M + m),
        t = (F + m l theta'^2 sin) / (M + m),                        sin, cos those of theta.

    The equations, and the parameters, of Barto, Sutton and Anderson (*Neuronlike adaptive elements*, 1983) without friction,
    in the sign convention of Gymnasium's CartPole-v1. State: position in m, pole in rad, velocity in m/s, spin in rad/s;
    force in N. Cost: `1 - cos theta + (position_weight p^2 + velocity_weight p'^2 + spin_weight theta'^2 + force_weight
    F^2) / 2`. The box is the ``track`` (its half), ``max_velocity`` and ``max_spin``; it starts in ``start``, at any angle.

    Without noise mass gathers at the state of rest faster than the discount forgets it (`mu*` is declared unbounded where
    the linear system and the quadratic cost there say so). ``force_noise`` in N sqrt(s) enters as the force does; with it, or
    ``noise``, nothing is known of `mu*`. Raises `InputError` for wrong arguments.
    """

    gymnasium = "CartPole-v1"

    def __init__(
        self,
        gravity: float = 9.8,
        cart_mass: float = 1.0,
        pole_mass: float = 0.1,
        half_length: float = 0.5,
        track: float = 2.4,
        max_velocity: float = 5.0,
        max_spin: float = 10.0,
        position_weight: float = 0.2,
        velocity_weight: float = 0.02,
        spin_weight: float = 0.02,
        force_weight: float = 0.005,
        failure_cost: float | None = None,
        start: Start = None,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: float | Sequence[float] | None = 10.0,
        force_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        positive = lambda name, value: require_number(f"problem.{name}", value, above=0.0)
        weight = lambda name, value: require_number(f"problem.{name}", value, at_least=0.0)
        self.gravity = weight("gravity", gravity)
        self.cart_mass, self.pole_mass = positive("cart_mass", cart_mass), positive("pole_mass", pole_mass)
        self.half_length, self.track = positive("half_length", half_length), positive("track", track)
        self.max_velocity, self.max_spin = positive("max_velocity", max_velocity), positive("max_spin", max_spin)
        self.position_weight = weight("position_weight", position_weight)
        self.velocity_weight = weight("velocity_weight", velocity_weight)
        self.spin_weight = weight("spin_weight", spin_weight)
        self.force_weight = positive("force_weight", force_weight)
        self.force_noise = weight("force_noise", force_noise)
        box: list[Angle | Interval] = [
            Interval("position", -self.track, self.track, "m"),
            Angle("pole"),
            Interval("velocity", -self.max_velocity, self.max_velocity, "m/s"),
            Interval("spin", -self.max_spin, self.max_spin, "rad/s"),
        ]
        halves = {c.name: (0.5 * c.low, 0.5 * c.high) for c in box if isinstance(c, Interval)}
        super().__init__(
            box,
            ["force [N]"],
            discount,
            exponent,
            control_weight=self.force_weight,
            control_limit=control_limit,
            start=halves if start is None else start,
            noise=noise,
            failure_cost=failure_cost,
        )
        seams = torch.tensor([[0.5 * c.length if isinstance(c, Interval) else torch.pi for c in box]]).double()
        self.state_cost_bound = max(float(self.cost(seams)), self._failure)
        self.occupation_bound = bound_at_rest(self, [0.0] * self.dim)

    def cost(self, s: Tensor) -> Tensor:
        position, pole, velocity, spin = s.unbind(-1)
        squares = self.position_weight * position.square() + self.velocity_weight * velocity.square()
        # 1 - cos as 2 sin^2 of the half angle loses no digits near upright.
        return 2.0 * (0.5 * pole).sin().square() + 0.5 * (squares + self.spin_weight * spin.square())

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        _, pole, velocity, spin = s.unbind(-1)
        sin, cos, mass = pole.sin(), pole.cos(), self.cart_mass + self.pole_mass
        part = self.pole_mass * self.half_length / mass
        inertia = self.half_length * (4.0 / 3.0 - self.pole_mass / mass * cos.square())
        swing = part * spin.square() * sin
        falling = (self.gravity * sin - cos * swing) / inertia
        pushed = -cos / (mass * inertia)
        a = torch.stack([velocity, spin, swing - part * cos * falling, falling], dim=-1)
        zero = torch.zeros_like(pole)
        return a, torch.stack([zero, zero, 1.0 / mass - part * cos * pushed, pushed], dim=-1).unsqueeze(-1)

    def disturbance(self, s: Tensor) -> Tensor | None:
        return self.force_noise * self.dynamics(s)[1] if self.force_noise else None

    def observed(self, observation: np.ndarray) -> np.ndarray:
        position, velocity, pole, spin = observation
        return np.array([position, pole, velocity, spin])

    def action(self, control: np.ndarray) -> np.ndarray:
        """The number of the side that the force pushes to: the environment knows 10 N either way."""
        return np.array(control[0] > 0.0, dtype=np.int64)

    def joints(self, s: Tensor) -> Tensor:
        """The cart and the tip of the pole in m, up positive, ``(N, 2, 2)``."""
        position, rod = s[:, 0], 2.0 * self.half_length
        tip = torch.stack([position + rod * s[:, 1].sin(), rod * s[:, 1].cos()], dim=-1)
        return torch.stack([torch.stack([position, torch.zeros_like(position)], dim=-1), tip], dim=1)

    def energy(self, s: Tensor) -> Tensor:
        """Kinetic plus potential energy ``(N,)`` in J, the latter 0 with the pole upright."""
        _, pole, velocity, spin = s.unbind(-1)
        lever = self.pole_mass * self.half_length
        kinetic = 0.5 * (self.cart_mass + self.pole_mass) * velocity.square() + lever * pole.cos() * velocity * spin
        turning = 2.0 / 3.0 * lever * self.half_length * spin.square()
        return kinetic + turning - 2.0 * lever * self.gravity * (0.5 * pole).sin().square()
