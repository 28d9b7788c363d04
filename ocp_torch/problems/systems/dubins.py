r"""Dubins' vehicle in a periodic plane or a room: constant speed, only the turn rate is controlled; stay near a target."""

import math
from collections.abc import Sequence

from torch import Tensor

from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.units import TURN
from ocp_torch.problems.systems.planar import PlanarVehicle


class Dubins(PlanarVehicle):
    r"""`x' = speed cos(heading)`, `y' = speed sin(heading)`, `heading' = w`: `d = 3`, `m = 1`.

    Dubins (1957), with a price on turning, `|u|^q / q` of `u = w` in units of ``turn_rate`` turns/s, for a limit. The vehicle
    cannot stop: at best it circles near the target. The cost is that of `PlanarVehicle`.

    The drift is not in the range of `B`, so the paper's assumption A2 fails. What then still holds: `f`, `a`, `B` are
    smooth, so `V*` is bounded by `sup f`, continuous, and the viscosity solution; a smooth `V` with `Q <= 0` is at most
    `V*` by integration along any trajectory, so the shifted bound, and `F_M` with an `M >= sup mu*`, are lower bounds as
    before; simulated performance and the Lagrangian bound speak of the learned, smooth controller and need no optimum.
    What is lost is the a-priori bound on `u*` (Proposition 2), for which a least-squares `alpha` stands, and knowledge
    of `mu*`. It is declared unbounded where the vehicle can turn faster than the discount forgets: the flow then gathers on
    a circle about the target (an `inf` only keeps `F_M` out of the certificate). With ``heading_noise`` in rad/sqrt(s),
    ``position_noise`` in m/sqrt(s) or ``noise`` nothing is known of it.
    """

    def __init__(
        self,
        size: float = 4.0,
        target: Sequence[float] = (2.0, 2.0),
        obstacles: Sequence[Sequence[float]] = ((1.0, 2.6, 0.3),),
        clearance: float = 0.3,
        target_weight: float = 1.0,
        obstacle_weight: float = 2.0,
        speed: float = 1.0,
        turn_rate: float = 0.25,
        discount: float = 0.5,
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
        super().__init__(["turn rate [rad/s]"], size, speed, turn_rate, walls, failure_cost, *price, *noises)
        gathers = TURN * self.turn_rate > self.discount and not self.noisy
        self.occupation_bound = math.inf if gathers else None

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        moves = self.moves(s)
        return self.speed * moves[..., 0], moves[..., 1:]
