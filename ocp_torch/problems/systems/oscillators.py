r"""What phase oscillators share: Kuramoto's order parameter, and goals and costs of synchrony made of it."""

import torch
from torch import Tensor

from ocp_torch.errors import require_choice, require_number, require_numbers
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.angles import TURN, to_radians, to_turns

SYNCHRONISE, DESYNCHRONISE, ENTRAIN = "synchronise", "desynchronise", "entrain"


class Oscillators(Problem):
    """Phases that pull at one another. A subclass gives the dynamics, and calls `aim` and `run_at`."""

    goals: tuple[str, ...] = (SYNCHRONISE, DESYNCHRONISE)

    def aim(self, goal: str, weight: float) -> None:
        """Note the ``goal``, and the cost ``weight`` where it is missed altogether."""
        self.goal = require_choice("problem.goal", goal, self.goals)
        self.weight = self.state_cost_bound = require_number("problem.weight", weight, above=0.0)

    def run_at(self, frequencies: list[float], count: int, coupling: float, strength: float) -> None:
        """Note the ``count`` frequencies, the coupling and the strength of the control, all in rad/s."""
        self.frequencies = require_numbers("problem.frequencies", frequencies, count)
        self.coupling = require_number("problem.coupling", coupling)
        self.strength = require_number("problem.strength", strength, above=0.0)
        self._omega = torch.tensor(self.frequencies, dtype=torch.float64)

    def phases(self, x: Tensor) -> Tensor:
        """All phases in turns, ``(N, n)``."""
        return x

    def circular(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Cosine and sine of each phase, ``(N, n)``."""
        angle = TURN * self.phases(x)
        return angle.cos(), angle.sin()

    def order_parameter(self, x: Tensor) -> Tensor:
        r"""`r = |mean_j exp(i theta_j)|` in [0, 1], ``(N,)``: 1 in synchrony."""
        cosine, sine = self.circular(x)
        return torch.hypot(cosine.mean(dim=-1), sine.mean(dim=-1))

    def square_order(self, x: Tensor) -> Tensor:
        """`r^2`, a trigonometric polynomial, ``(N,)``."""
        cosine, sine = self.circular(x)
        return cosine.mean(dim=-1).square() + sine.mean(dim=-1).square()

    def state_cost(self, x: Tensor) -> Tensor:
        if self.goal == ENTRAIN:
            return self.weight * (0.5 * TURN * self.phases(x)).sin().square().mean(dim=-1)
        square = self.square_order(x)
        return self.weight * ((1.0 - square).clamp_min(0.0) if self.goal == SYNCHRONISE else square)

    def to_torus(self, phases: Tensor) -> Tensor:
        """Phases in radians ``(N, n)`` as states ``(N, d)``."""
        return to_turns(phases)

    def from_torus(self, x: Tensor) -> Tensor:
        """States as phases in [-pi, pi) radians, ``(N, n)``."""
        return to_radians(self.phases(x))
