r"""Spiking neurons reduced to their phases under one stimulus: break their synchrony, as deep brain stimulation should."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.errors import require_choice, require_integer, require_number
from ocp_torch.problems.arguments import require_numbers
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.angles import TURN, to_radians, to_turns
from ocp_torch.problems.systems.synchrony import DESYNCHRONISE, SYNCHRONISE, goal_cost, order_parameter

TYPE_1, TYPE_2 = "type1", "type2"


class PhaseNeurons(Problem):
    r"""`dtheta_i/dt = omega_i + (coupling / n) sum_j sin(theta_j - theta_i) + strength Z(theta_i) u`, `x = theta / 2 pi`.

    The phase reduction of Brown, Moehlis and Holmes (Neural Computation 16, 2004), one stimulus for all as in Wilson and
    Moehlis (SIAM Review 57, 2015): `m = 1`, `B_i = Z(x_i)`. The response `Z` is `1 - cos theta` for neurons of type1 (near
    a saddle-node on a circle), `-sin theta` for type2 (near a Hopf bifurcation); a neuron spikes at phase 0. ``frequencies``,
    ``coupling`` and ``strength`` are in rad/s, `u` is the stimulus in units of ``strength``. Cost: ``weight`` times `r^2` to
    desynchronise, `1 - r^2` to synchronise, `r` the order parameter.

    ``frequencies`` is a list, or null for ``frequency`` times equally spaced factors from `1 - spread / 2` to
    `1 + spread / 2`. The drift is not in the range of `B`, so the paper's assumption A2 fails; see `Dubins` for what then
    still holds. Where all phases agree the stimulus cannot part them. Raises `InputError` for wrong arguments.
    """

    def __init__(
        self,
        neurons: int = 2,
        response: str = TYPE_2,
        goal: str = DESYNCHRONISE,
        frequencies: list[float] | None = None,
        frequency: float = 2.0,
        spread: float = 0.2,
        coupling: float = 0.5,
        strength: float = 1.0,
        weight: float = 1.0,
        discount: float = 0.7,
        exponent: float = 2.0,
        control_limit: float | None = None,
    ) -> None:
        n = require_integer("problem.neurons", neurons, 2, maximum=512)
        super().__init__(n, 1, discount, exponent, control_limit)
        self.neurons = n
        self.response = require_choice("problem.response", response, (TYPE_1, TYPE_2))
        self.goal = require_choice("problem.goal", goal, (DESYNCHRONISE, SYNCHRONISE))
        self.frequency = require_number("problem.frequency", frequency)
        self.spread = require_number("problem.spread", spread, at_least=0.0)
        self.coupling = require_number("problem.coupling", coupling)
        self.strength = require_number("problem.strength", strength, above=0.0)
        self.weight = require_number("problem.weight", weight, above=0.0)
        factors = 1.0 + self.spread * torch.linspace(-0.5, 0.5, n, dtype=torch.float64)
        given = (self.frequency * factors).tolist() if frequencies is None else frequencies
        self.frequencies = require_numbers("problem.frequencies", given, n)
        self._omega = torch.tensor(self.frequencies, dtype=torch.float64)
        self.state_cost_bound = self.weight

    def order_parameter(self, x: Tensor) -> Tensor:
        """`r` in [0, 1], ``(N,)``."""
        return order_parameter(x)

    def state_cost(self, x: Tensor) -> Tensor:
        return self.weight * goal_cost(self.goal, x)

    def drift(self, x: Tensor) -> Tensor:
        cosine, sine = (TURN * x).cos(), (TURN * x).sin()
        pulled = cosine * sine.mean(dim=-1, keepdim=True) - sine * cosine.mean(dim=-1, keepdim=True)
        return (self._like(x, "omega", self._omega) + self.coupling * pulled) / TURN

    def drift_divergence(self, x: Tensor) -> Tensor:
        """`-coupling (n r^2 - 1)`: each neuron's own term is no coupling."""
        cosine, sine = (TURN * x).cos(), (TURN * x).sin()
        return self.coupling * (1.0 - self.neurons * (cosine.mean(dim=-1).square() + sine.mean(dim=-1).square()))

    def control_matrix(self, x: Tensor) -> Tensor:
        angle = TURN * x
        Z = 1.0 - angle.cos() if self.response == TYPE_1 else -angle.sin()
        return (self.strength / TURN * Z).unsqueeze(-1)

    def control_divergence(self, x: Tensor) -> Tensor:
        angle = TURN * x
        slope = angle.sin() if self.response == TYPE_1 else -angle.cos()
        return self.strength * slope.sum(dim=-1, keepdim=True)

    def to_torus(self, phases: Tensor) -> Tensor:
        """Phases in radians ``(N, n)`` as states."""
        return to_turns(phases)

    def from_torus(self, x: Tensor) -> Tensor:
        """States as phases in [-pi, pi) radians, ``(N, n)``; a neuron spikes at 0."""
        return to_radians(x)
