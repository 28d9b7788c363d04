r"""The base class of phase oscillators: Kuramoto's order parameter, and goals and costs of synchrony made of it."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_choice, require_number, require_numbers
from ocp_torch.problems.constant_noise import one_or_each
from ocp_torch.problems.physical.system import System

SYNCHRONISE = "synchronise"
DESYNCHRONISE = "desynchronise"
ENTRAIN = "entrain"


class Oscillators(System):
    """Phases, in rad, that pull at one another. A subclass gives the dynamics, and calls `aim`, `run_at` and `shake`."""

    goals: tuple[str, ...] = (SYNCHRONISE, DESYNCHRONISE)

    def aim(self, goal: str, weight: float) -> None:
        """Set the ``goal``, and the ``weight`` of the cost, its largest value."""
        self.goal = require_choice("problem.goal", goal, self.goals)
        self.weight = self.state_cost_bound = require_number("problem.weight", weight, above=0.0)

    def run_at(self, frequencies: list[float], count: int, coupling: float) -> None:
        """Set the ``count`` frequencies and the coupling, all in rad/s."""
        self.frequencies = require_numbers("problem.frequencies", frequencies, count)
        self.coupling = require_number("problem.coupling", coupling)
        self._omega = torch.tensor(self.frequencies, dtype=torch.float64)

    def shake(self, phase_noise: float | Sequence[float], coordinates: Tensor) -> None:
        """Set the ``phase_noise``, in rad/sqrt(s): one for each of the phases, or one for all. The matrix ``coordinates``
        ``(d, n)`` takes phases to states."""
        each = one_or_each("problem.phase_noise", phase_noise, coordinates.shape[1])
        self.phase_noise = phase_noise
        self.disturb(coordinates * torch.tensor(each, dtype=torch.float64))

    def phases(self, s: Tensor) -> Tensor:
        """All phases, ``(N, n)``."""
        return s

    def circular(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Cosine and sine of each phase, ``(N, n)``."""
        phases = self.phases(s)
        return phases.cos(), phases.sin()

    def order_parameter(self, x: Tensor) -> Tensor:
        r"""`r = |mean_j exp(i theta_j)|` in [0, 1], ``(N,)``, at states of the torus: 1 in synchrony."""
        return self.square_order(self.from_torus(x)).sqrt()

    def square_order(self, s: Tensor) -> Tensor:
        """`r^2`, a trigonometric polynomial, ``(N,)``."""
        cosine, sine = self.circular(s)
        return cosine.mean(dim=-1).square() + sine.mean(dim=-1).square()

    def cost(self, s: Tensor) -> Tensor:
        if self.goal == ENTRAIN:
            return self.weight * (0.5 * self.phases(s)).sin().square().mean(dim=-1)
        square = self.square_order(s)
        return self.weight * ((1.0 - square).clamp_min(0.0) if self.goal == SYNCHRONISE else square)
