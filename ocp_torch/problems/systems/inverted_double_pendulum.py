r"""Balance two poles, one on top of the other, on a cart that is pushed along a rail: d = 6, one force."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import require_number, require_numbers
from ocp_torch.problems.physical.coordinates import Interval
from ocp_torch.problems.physical.start import Start
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.systems.rest import bound_at_rest

# The force in N of the environment's action 1: `gear` of its motor.
GEAR = 500.0
# Default ranges of the start, to either side of rest. Gymnasium starts within 0.1 m, each joint within 0.1 rad (the upper
# tilt is the sum of two), at normal rates of deviation 0.1.
STARTS = {"position": 0.2, "lower tilt": 0.15, "upper tilt": 0.3, "velocity": 0.3, "lower spin": 0.3, "upper spin": 0.5}


class InvertedDoublePendulum(System):
    r"""`M(q) q'' = h(q, q') + (F, 0, 0)` of the place `p` of a cart and the tilts of two poles, each from upright.

    A model of Gymnasium's InvertedDoublePendulum-v5. State: position in m, tilts in rad, velocity in m/s, spins in rad/s;
    force in N. Both tilts are absolute: MuJoCo's second joint is `upper tilt - lower tilt`. Cost: `sum_i (1 - cos tilt_i)
    + (position_weight p^2 + velocity_weight p'^2 + spin_weight |tilts'|^2 + force_weight F^2) / 2`.

    Defaults are those of Gymnasium 1.4's `inverted_double_pendulum.xml` as MuJoCo 4.0 compiles it (`body_mass` and
    `body_inertia`, of capsules of 1000 kg/m^3): ``masses`` of cart and poles in kg, ``lengths`` in m, ``centres`` of mass in
    m from the lower end, ``inertias`` about those in kg m^2, viscous ``damping`` of the rail in N s/m and of the joints in
    N m s/rad. Left out are the stops at the ends of the rail and a gravity of 1e-5 m/s^2 along it.

    The box is the ``track`` (its half), ``max_tilt``, ``max_velocity`` and ``max_spin``; leaving it is a failure. In
    Gymnasium episodes end when the tip is no higher than 1 m, as it is wherever a tilt is more than 0.85 rad, and rates are
    shown up to 10. ``force_noise`` in N sqrt(s) enters as the force does. Raises `InputError` for wrong arguments.
    """

    gymnasium = "InvertedDoublePendulum-v5"

    def __init__(
        self,
        masses: Sequence[float] = (10.47197551196598, 4.1987385815227585, 4.1987385815227585),
        lengths: Sequence[float] = (0.6, 0.6),
        centres: Sequence[float] = (0.3, 0.3),
        inertias: Sequence[float] = (0.15497066975016235, 0.15497066975016235),
        damping: Sequence[float] = (0.05, 0.05, 0.05),
        gravity: float = 9.81,
        track: float = 1.0,
        max_tilt: float = 0.85,
        max_velocity: float = 5.0,
        max_spin: float = 10.0,
        position_weight: float = 0.2,
        velocity_weight: float = 0.02,
        spin_weight: float = 0.02,
        force_weight: float = 2e-5,
        failure_cost: float | None = None,
        start: Start = None,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: float | Sequence[float] | None = GEAR,
        force_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        positive = lambda name, value: require_number(f"problem.{name}", value, above=0.0)
        weight = lambda name, value: require_number(f"problem.{name}", value, at_least=0.0)
        several = lambda name, value, count: require_numbers(f"problem.{name}", value, count, above=0.0)
        self.masses, self.lengths = several("masses", masses, 3), several("lengths", lengths, 2)
        self.centres, self.inertias = several("centres", centres, 2), several("inertias", inertias, 2)
        self.damping = require_numbers("problem.damping", damping, 3)
        for i, value in enumerate(self.damping):
            weight(f"damping[{i}]", value)
        self.gravity, self.track = weight("gravity", gravity), positive("track", track)
        self.max_tilt = positive("max_tilt", max_tilt)
        self.max_velocity, self.max_spin = positive("max_velocity", max_velocity), positive("max_spin", max_spin)
        self.position_weight = weight("position_weight", position_weight)
        self.velocity_weight = weight("velocity_weight", velocity_weight)
        self.spin_weight = weight("spin_weight", spin_weight)
        self.force_weight = positive("force_weight", force_weight)
        self.force_noise = weight("force_noise", force_noise)
        ends = [self.track, self.max_tilt, self.max_tilt, self.max_velocity, self.max_spin, self.max_spin]
        units = ["m", "rad", "rad", "m/s", "rad/s", "rad/s"]
        super().__init__(
            [Interval(name, -end, end, unit) for name, end, unit in zip(STARTS, ends, units, strict=True)],
            ["force [N]"],
            discount,
            exponent,
            control_weight=self.force_weight,
            control_limit=control_limit,
            start={name: (-most, most) for name, most in STARTS.items()} if start is None else start,
            noise=noise,
            failure_cost=failure_cost,
        )
        (_, m1, m2), (l1, l2), (r1, r2), (I1, I2) = self.masses, self.lengths, self.centres, self.inertias
        self._lengths = torch.tensor([[l1], [l2]], dtype=torch.float64)
        self._levers = m1 * r1 + m2 * l1, m2 * r2
        self._turning = I1 + m1 * r1**2 + m2 * l1**2, I2 + m2 * r2**2, m2 * l1 * r2
        self.state_cost_bound = max(float(self.cost(0.5 * self.chart.length.unsqueeze(0))), self._failure)
        self.occupation_bound = bound_at_rest(self, [0.0] * self.dim)

    def cost(self, s: Tensor) -> Tensor:
        squares = self.position_weight * s[:, 0].square() + self.velocity_weight * s[:, 3].square()
        # 1 - cos as 2 sin^2 of the half angle loses no digits near upright.
        tilted = 2.0 * (0.5 * s[:, 1:3]).sin().square().sum(dim=-1)
        return tilted + 0.5 * (squares + self.spin_weight * s[:, 4:].square().sum(dim=-1))

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        _, t1, t2, v, w1, w2 = s.unbind(-1)
        (h1, h2), (j1, j2, k), mass = self._levers, self._turning, sum(self.masses)
        b1, b2, j12, bend = h1 * t1.cos(), h2 * t2.cos(), k * (t1 - t2).cos(), k * (t1 - t2).sin()
        # The mass matrix after elimination of the cart's row.
        n11, n12, n22 = j1 - b1.square() / mass, j12 - b1 * b2 / mass, j2 - b2.square() / mass
        det = n11 * n22 - n12.square()

        def accelerated(force, torque1, torque2) -> tuple[Tensor, Tensor, Tensor]:
            f1, f2 = torque1 - b1 / mass * force, torque2 - b2 / mass * force
            a1, a2 = (n22 * f1 - n12 * f2) / det, (n11 * f2 - n12 * f1) / det
            return (force - b1 * a1 - b2 * a2) / mass, a1, a2

        rubbed = self.damping[2] * (w2 - w1)
        free = accelerated(
            h1 * t1.sin() * w1.square() + h2 * t2.sin() * w2.square() - self.damping[0] * v,
            self.gravity * h1 * t1.sin() - bend * w2.square() - self.damping[1] * w1 + rubbed,
            self.gravity * h2 * t2.sin() + bend * w1.square() - rubbed,
        )
        zero = torch.zeros_like(v)
        pushed = torch.stack([zero, zero, zero, *accelerated(1.0, 0.0, 0.0)], dim=-1)
        return torch.stack([v, w1, w2, *free], dim=-1), pushed.unsqueeze(-1)

    def disturbance(self, s: Tensor) -> Tensor | None:
        return self.force_noise * self.dynamics(s)[1] if self.force_noise else None

    def observed(self, observation: np.ndarray) -> np.ndarray:
        """The physical state ``(6,)`` of an observation, without its last entry, the force of the stops."""
        p, s1, s2, c1, c2, v, w1, w2, _ = observation
        first = np.arctan2(s1, c1)
        return np.array([p, first, first + np.arctan2(s2, c2), v, w1, w1 + w2])

    def action(self, control: np.ndarray) -> np.ndarray:
        return control / GEAR

    def joints(self, s: Tensor) -> Tensor:
        """The cart, the joint between the poles and the tip in m, up positive, ``(N, 3, 2)``."""
        cart = torch.stack([s[:, 0], torch.zeros_like(s[:, 0])], dim=-1).unsqueeze(1)
        poles = torch.stack([s[:, 1:3].sin(), s[:, 1:3].cos()], dim=-1) * self._like(s, "lengths", self._lengths)
        return torch.cat([cart, cart + poles.cumsum(dim=1)], dim=1)

    def energy(self, s: Tensor) -> Tensor:
        """Kinetic plus potential energy ``(N,)`` in J, the latter 0 with both poles upright."""
        _, t1, t2, v, w1, w2 = s.unbind(-1)
        (h1, h2), (j1, j2, k) = self._levers, self._turning
        squares = 0.5 * (sum(self.masses) * v.square() + j1 * w1.square() + j2 * w2.square())
        mixed = (h1 * t1.cos() * w1 + h2 * t2.cos() * w2) * v + k * (t1 - t2).cos() * w1 * w2
        return squares + mixed - 2.0 * self.gravity * (h1 * (0.5 * t1).sin().square() + h2 * (0.5 * t2).sin().square())
