"""The first steps of a simulation, before any is halved: how many, and how they are spread over its time."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.simulated.loops import HeldLoop, Loop
from ocp_torch.maths.runge_kutta import Dynamics, Switched

# A kink of V is met at the start of a trajectory or never, and what is late counts little: early steps are shorter.
GRADING = 2.0
# The first steps, before any is halved: so many at least, in each of which no more than that part of a discount time passes,
# and no trajectory moves farther than that part of a turn. Coarser ones are halved more often, finer ones cost more at once.
FEWEST_STEPS, DISCOUNTED, MOVED = 8, 0.4, 0.2
# Steps follow from the speed that so many trajectories do not exceed at their starts, where the fastest is more than so many
# times as fast: what is faster takes as many times more of them. A double pendulum's fastest start is ten times as fast.
MOSTLY, RARELY = 0.9, 2.0


def paced(speeds: Tensor, together: bool) -> tuple[float, Tensor]:
    """The speed that steps follow from, and how many times as many each trajectory takes, ``(N,)``, for ``speeds`` ``(N,)``
    at the starts: one number for all where they must go ``together``, or none is much faster than most."""
    most, fastest = float(speeds.sort().values[int(MOSTLY * (len(speeds) - 1))]), float(speeds.max())
    if together or not fastest > RARELY * most > 0.0:
        return fastest, torch.ones_like(speeds, dtype=torch.long)
    return most, (speeds / most).ceil().clamp_min(1.0).long()


@dataclass(frozen=True)
class Steps:
    """``count`` steps up to ``horizon``, graded, of which each trajectory takes ``multiples`` ``(N,)`` times as many; a
    control that is held is renewed at ``renewals`` of them, 0 for one that is not."""

    horizon: float
    count: int
    grading: float
    multiples: Tensor
    renewals: int = 0

    @classmethod
    def of(cls, loop: Loop, horizon: float, velocity: Tensor) -> "Steps":
        """The first ones, an even number per hold, for ``loop``, which moves with ``velocity`` ``(N, d)`` at its starts."""
        rho, together = loop.problem.discount, torch.ones(len(velocity), dtype=torch.long)
        if isinstance(loop, HeldLoop):
            holds = math.ceil(horizon / loop.hold)
            return cls(holds * loop.hold, 2 * holds * math.ceil(0.5 * loop.substeps), 1.0, together, holds)
        speed, multiples = paced(velocity.norm(dim=-1), loop.problem.noisy)
        steps = 2 * math.ceil(0.5 * horizon * max(rho / DISCOUNTED, speed / MOVED))
        return cls(horizon, max(FEWEST_STEPS, steps), GRADING, multiples)

    def taken_by(self, loop: Loop) -> Dynamics:
        """The dynamics of ``loop``, with its renewals."""
        return Switched(loop, loop.renewed, self.renewals) if self.renewals else loop
