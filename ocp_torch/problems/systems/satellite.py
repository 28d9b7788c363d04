r"""Turn a satellite to point where it should, and bring it to rest, by torques about its three axes."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number, require_numbers, shown
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.coordinates import Interval
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.systems.rest import bound_at_rest

# Starts are in these parts of the box, along each axis: of the attitudes (half a turn about one axis is 1), and of the rates.
ATTITUDES = 0.6
RATES = 0.3
LIMITS = [20.0, 20.0, 20.0]  # N m


class Satellite(System):
    r"""`sigma' = ((1 - |sigma|^2) omega + 2 sigma x omega + 2 (sigma . omega) sigma) / 4`, `J omega' = u - omega x J omega`.

    `sigma = tan(phi / 4) n` are the modified Rodrigues parameters of the turn by `phi` about the axis `n` that leads from
    the wanted attitude to the present one, `omega` the rates about the body's axes in rad/s, `u` the torques about them in
    N m (the wheels' own spin is neglected), each within ``control_limit``. `d = 6`, `m = 3`. Three angles have no chart
    without a singularity: that of Euler's is met at a quarter turn, that of this one at a whole turn, where `sigma` is
    infinite. The box `|sigma_i| <= 1` has every attitude (turns up to half a one are `|sigma| <= 1`) and excludes turns of
    more than that about any of the three axes: a satellite that tumbles on is outside, where there is no second chart to
    go on with. A turn by `phi` one way and by `2 pi - phi` the other are different states.

    Cost `8 |sigma|^2 / (1 + |sigma|^2) = 4 (1 - cos(phi / 2))`, about `phi^2 / 2`, `+ rate_cost |omega|^2
    + torque_cost |u|^2 / 2`. ``inertia`` in kg m^2 and the limit are those of Wie, Weiss and Arapostathis (*Quaternion
    feedback regulator for spacecraft eigenaxis rotations*, 1989). Starts are in the inner part of the box, up to 170 degrees
    from the wanted attitude; ``torque_noise`` in N m sqrt(s) enters as each torque does. Raises `InputError` for wrong
    arguments.
    """

    def __init__(
        self,
        inertia: Sequence[Sequence[float]] = ((1200.0, 100.0, -200.0), (100.0, 2200.0, 300.0), (-200.0, 300.0, 3100.0)),
        max_rate: float = 0.15,
        rate_cost: float = 20.0,
        torque_cost: float = 0.005,
        discount: float = 0.05,
        exponent: float = 2.0,
        control_limit: Limit = LIMITS,
        torque_noise: float = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.inertia = _require_inertia(inertia)
        self.max_rate = require_number("problem.max_rate", max_rate, above=0.0)
        self.rate_cost = require_number("problem.rate_cost", rate_cost, at_least=0.0)
        self.torque_cost = require_number("problem.torque_cost", torque_cost, above=0.0)
        self.torque_noise = require_number("problem.torque_noise", torque_noise, at_least=0.0)
        self._inertia = torch.tensor(self.inertia, dtype=torch.float64)
        turns = [Interval(f"sigma {axis}", -1.0, 1.0) for axis in "xyz"]
        rates = [Interval(f"rate {axis}", -self.max_rate, self.max_rate, "rad/s") for axis in "xyz"]
        parts = [(turn, ATTITUDES) for turn in turns] + [(rate, RATES) for rate in rates]
        super().__init__(
            [*turns, *rates],
            [f"torque {axis} [N m]" for axis in "xyz"],
            discount,
            exponent,
            control_weight=self.torque_cost,
            control_limit=control_limit,
            start={c.name: (part * c.low, part * c.high) for c, part in parts},
            noise=noise,
        )
        seam = torch.tensor([[0.5 * c.length for c in self.coordinates]], dtype=torch.float64)
        self.state_cost_bound = float(self.cost(seam))
        self.occupation_bound = bound_at_rest(self, [0.0] * 6)

    def angle(self, s: Tensor) -> Tensor:
        """The pointing error in rad, the shorter way round, ``(N,)``, at physical states ``(N, d)``."""
        size = s[:, :3].norm(dim=-1)
        return 4.0 * torch.atan(torch.minimum(size, 1.0 / size))

    def cost(self, s: Tensor) -> Tensor:
        square = s[:, :3].square().sum(dim=-1)
        return 8.0 * square / (1.0 + square) + self.rate_cost * s[:, 3:].square().sum(dim=-1)

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        sigma, omega = s[:, :3], s[:, 3:]
        J = self._like(s, "inertia", self._inertia)
        along = (sigma * omega).sum(dim=-1, keepdim=True)
        rest = 1.0 - sigma.square().sum(dim=-1, keepdim=True)
        turning = 0.25 * (rest * omega + 2.0 * torch.linalg.cross(sigma, omega) + 2.0 * along * sigma)
        inverse = self._like(s, "inverse", self._inertia.inverse())
        push = torch.cat([torch.zeros_like(inverse), inverse])
        return torch.cat([turning, -torch.linalg.cross(omega, omega @ J) @ inverse], dim=-1), push.expand(len(s), 6, 3)

    def disturbance(self, s: Tensor) -> Tensor | None:
        return self.torque_noise * self.dynamics(s)[1] if self.torque_noise else None


def _require_inertia(given: object) -> list[list[float]]:
    """``given`` if it is the inertia of a body: symmetric, its moments positive and none above the sum of the others."""
    rows = given if isinstance(given, Sequence) and not isinstance(given, str) else []
    if len(rows) != 3:
        raise InputError(f"problem.inertia is {shown(given)}, but must be three rows of three numbers, in kg m^2.")
    found = [require_numbers(f"problem.inertia[{i}]", row, 3) for i, row in enumerate(rows)]
    J = torch.tensor(found, dtype=torch.float64)
    moments = torch.linalg.eigvalsh(J)
    if not torch.equal(J, J.T) or float(moments[0]) <= 0.0 or float(moments[2]) > float(moments[0] + moments[1]):
        raise InputError(
            f"problem.inertia is {shown(given)}, but must be symmetric, and its principal moments positive, none above the "
            "sum of the two others."
        )
    return found
