"""How fast a problem moves: the time step of simulated pieces, whatever the unit of time."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.fields.fields import typical_sizes
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems import Problem

# A step is at most this part of `1 / rho`, and in it half of all states move by no more than this part of a turn: the control
# is held that long. With 0.05 of a turn a limited pendulum lost at upright what it had won, from round to round; with 0.02
# it stayed, and a cart-pole was no worse.
DISCOUNTED, MOVED = 0.04, 0.02
# A Runge-Kutta step is at most this part of the time in which neighbours part `e`-fold, at nine states in ten; so many at
# most.
PARTED, NEARLY_ALL, MOST_SUBSTEPS = 0.5, 0.9, 8
# States at which that is looked at, and how far apart neighbours are, in turns.
PROBED, APART = 2**11, 1e-3


@dataclass(frozen=True)
class Pace:
    """A control is held for ``step`` units of time, which Runge-Kutta takes in ``substeps``."""

    step: float
    substeps: int

    @classmethod
    @torch.no_grad()
    def of(cls, problem: Problem) -> "Pace":
        """That of ``problem`` under controls of its typical size, and within its limits, at states spread over the torus."""
        generator = fixed_generator()
        draw = lambda n, by=torch.randn: by(PROBED, n, dtype=torch.float64, generator=generator)
        x = draw(problem.dim, torch.rand)
        away, u = (torch.nn.functional.normalize(draw(n), dim=-1) for n in (problem.dim, problem.control_dim))
        u = problem.control_cost.within(typical_sizes(problem)[1] * u, torch.ones_like(x[:, 0]))
        velocity = problem.velocity(x, u)
        parting = (problem.velocity(x + APART * away, u) - velocity).norm(dim=-1) / APART
        speed, rate = float(velocity.norm(dim=-1).median()), float(parting.quantile(NEARLY_ALL))
        step = min(DISCOUNTED / problem.discount, MOVED / max(speed, 1e-300))
        return cls(step, min(max(1, math.ceil(step * rate / PARTED)), MOST_SUBSTEPS))

    def move(self, problem: Problem, x: Tensor, u: Tensor, velocity: Tensor) -> Tensor:
        """States ``(N, d)`` one step after ``x`` under the held controls ``u`` ``(N, m)``, not wrapped, without noise;
        ``velocity`` is that at ``x``."""
        h = self.step / self.substeps
        for k in range(self.substeps):
            v1 = velocity if k == 0 else problem.velocity(x, u)
            v2 = problem.velocity(x + 0.5 * h * v1, u)
            v3 = problem.velocity(x + 0.5 * h * v2, u)
            v4 = problem.velocity(x + h * v3, u)
            x = x + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)
        return x
