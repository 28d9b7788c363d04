r"""A unicycle in a periodic plane or a room: speed and turn rate are the controls, a target and round obstacles the cost."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.systems.planar import PlanarVehicle


class Unicycle(PlanarVehicle):
    r"""`x' = v cos(heading)`, `y' = v sin(heading)`, `heading' = w`: `d = 3`, `m = 2`, no drift.

    The kinematic model of a wheeled robot that cannot slide sideways (LaValle, *Planning Algorithms*, section 13.1.2). Its
    price is `|u|^q / q` of `u_1 = v`, in units of ``speed`` m/s, and `u_2 = w`, in units of ``turn_rate`` turns per second;
    the cost is that of `PlanarVehicle`. Where the flow contracts onto the target line by line faster than the discount
    forgets, which for `q = 2` is `2 target_weight speed^2 >= 2 discount^2`, `mu*` is declared unbounded; not with
    ``heading_noise`` in rad/sqrt(s), ``position_noise`` in m/sqrt(s) or ``noise``.
    """

    driftless = True

    def __init__(
        self,
        size: float = 4.0,
        target: Sequence[float] = (2.0, 2.0),
        obstacles: Sequence[Sequence[float]] = ((1.0, 2.6, 0.3), (2.9, 1.1, 0.3)),
        clearance: float = 0.3,
        target_weight: float = 1.0,
        obstacle_weight: float = 4.0,
        speed: float = 1.0,
        turn_rate: float = 0.25,
        discount: float = 1.0,
        exponent: float = 2.0,
        control_limit: Limit = None,
        heading_noise: float = 0.0,
        position_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
        walls: bool = False,
        failure_cost: float | None = None,
    ) -> None:
        self.pursue(2, target, obstacles, clearance, target_weight, obstacle_weight)
        price, noises = (discount, exponent, control_limit), (heading_noise, position_noise, noise)
        controls = ["speed [m/s]", "turn rate [rad/s]"]
        super().__init__(controls, size, speed, turn_rate, walls, failure_cost, *price, *noises)
        # With V = p r^2 / 2 along the heading: p + (speed p)^2 / rho^2 = 2 target_weight, contraction speed^2 p / rho. The
        # control vanishes at the target, so that no limit changes any of it there.
        fast = not self.noisy and self.target_weight * self.speed**2 >= self.discount**2
        self.occupation_bound = math.inf if fast and self.exponent == 2.0 else None

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        return torch.zeros_like(s), self.moves(s)
