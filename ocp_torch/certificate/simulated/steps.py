"""The first steps of a simulation, before any is halved: how many, and how they are spread over its time."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.simulated.loops import HeldLoop, Loop
from ocp_torch.maths.runge_kutta import Dynamics, Switched

GRADING = 2.0  # early steps are shorter: kinks of V are met at the start or never, and late costs are small
FEWEST_STEPS = 8  # at first, before any is halved
STEP_TIME = 0.4  # of the longest first step, in discount times
# Farthest that a trajectory moves in a first step, in turns: coarser steps are halved more often, finer ones cost more.
STEP_LENGTH = 0.2
# Part of the trajectories whose speed at the start is not above the one that steps follow from,
TYPICAL_PART = 0.9
# if the fastest is more than so many times as fast; faster ones take more steps. A double pendulum's is ten times as fast.
MUCH_FASTER = 2.0


def paced(speeds: Tensor, together: bool) -> tuple[float, Tensor]:
    """The speed that steps follow from, and how many times as many each trajectory takes, ``(N,)``, for ``speeds`` ``(N,)``
    at the starts: one number for all where they must go ``together``, or none is much faster than most."""
    most, fastest = float(speeds.sort().values[int(TYPICAL_PART * (len(speeds) - 1))]), float(speeds.max())
    if together or not fastest > MUCH_FASTER * most > 0.0:
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
        """The first steps, an even number a hold, for ``loop``, which moves with ``velocity`` ``(N, d)`` at its starts."""
        rho, together = loop.problem.discount, torch.ones(len(velocity), dtype=torch.long)
        if isinstance(loop, HeldLoop):
            holds = math.ceil(horizon / loop.hold)
            return cls(holds * loop.hold, 2 * holds * math.ceil(0.5 * loop.substeps), 1.0, together, holds)
        speed, multiples = paced(velocity.norm(dim=-1), loop.problem.noisy)
        steps = 2 * math.ceil(0.5 * horizon * max(rho / STEP_TIME, speed / STEP_LENGTH))
        return cls(horizon, max(FEWEST_STEPS, steps), GRADING, multiples)

    def taken_by(self, loop: Loop) -> Dynamics:
        """The dynamics of ``loop``, with its renewals."""
        return Switched(loop, loop.renewed, self.renewals) if self.renewals else loop
