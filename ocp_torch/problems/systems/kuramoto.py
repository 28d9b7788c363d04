r"""Kuramoto's coupled phase oscillators on a graph, some of them pushed: synchronise, desynchronise or entrain them."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_integer, require_number
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.systems.angles import TURN
from ocp_torch.problems.systems.graphs import GRAPHS, adjacency
from ocp_torch.problems.systems.oscillators import ENTRAIN, SYNCHRONISE, Oscillators


class Kuramoto(Oscillators):
    r"""`dtheta_i/dt = omega_i + (coupling / n) sum_j A_ij sin(theta_j - theta_i) + strength u_i`, `x = theta / 2 pi`.

    Kuramoto (1975), on a graph as in Rodrigues et al. (Physics Reports 610, 2016). Phases are in radians, ``frequencies``
    `omega`, ``coupling`` and ``strength`` in rad/s; `u_i` acts on those in ``controlled`` (numbers from 0; null: all).
    Cost: ``weight`` times `1 - r^2` to synchronise, `r^2` to desynchronise (`r` the order parameter), or
    `mean_i (1 - cos theta_i) / 2` to entrain, that is to bring all to phase 0.

    ``relative`` phases `y_i = x_i - x_n`, `i < n`, drop one dimension and lose nothing where the cost depends on
    differences alone: it is the default to (de)synchronise, and refused to entrain. ``frequencies`` is a list, or null for
    normal draws of deviation ``spread`` by ``seed``, shifted to mean 0; ``graph`` is complete, ring, random (by
    ``probability`` and ``seed``), a file or a list of rows. The flow contracts onto the goal: `mu*` is declared unbounded,
    also under a control limit (an `inf` only keeps `F_M` out of the certificate); not with ``phase_noise``, in rad/sqrt(s)
    for all oscillators or each, which moves all differences to the last one where that strays, or ``noise``, of
    coordinates. Where not all oscillators are controlled, assumption A2 of the paper fails (see `Dubins` for what then
    still holds). Raises `InputError` for wrong arguments.
    """

    goals = (*Oscillators.goals, ENTRAIN)

    def __init__(
        self,
        oscillators: int = 3,
        goal: str = SYNCHRONISE,
        graph: str | list[list[float]] = "complete",
        coupling: float = 0.5,
        frequencies: list[float] | None = None,
        spread: float = 0.5,
        controlled: list[int] | None = None,
        strength: float = 2.0,
        weight: float = 1.0,
        relative: bool | None = None,
        probability: float = 0.3,
        discount: float = 1.0,
        exponent: float = 2.0,
        seed: int = 0,
        control_limit: Limit = None,
        phase_noise: float | Sequence[float] = 0.0,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        self.oscillators = n = require_integer("problem.oscillators", oscillators, 2, maximum=512)
        self.relative = goal != ENTRAIN if relative is None else require_flag("problem.relative", relative)
        if self.relative and goal == ENTRAIN:
            raise InputError("problem.relative is true, but problem.goal = entrain asks for phases, not differences.")
        self.controlled = _subset(controlled, n)
        super().__init__(n - self.relative, len(self.controlled), discount, exponent, control_limit, noise)
        self.aim(goal, weight)
        self.seed = require_integer("problem.seed", seed, 0)
        self.spread = require_number("problem.spread", spread, at_least=0.0)
        self.probability = require_number("problem.probability", probability, at_least=0.0, at_most=1.0)
        if frequencies is None:
            drawn = torch.randn(n, generator=torch.Generator().manual_seed(self.seed), dtype=torch.float64)
            frequencies = (self.spread * (drawn - drawn.mean())).tolist()
        self.run_at(frequencies, n, coupling, strength)
        self._adjacency = adjacency("problem.graph", graph, n, self.probability, self.seed)
        # Rows, not a file's name: what is saved with a controller must not depend on another file.
        self.graph = graph if graph in GRAPHS else self._adjacency.tolist()
        coordinates = torch.eye(n, dtype=torch.float64)
        if self.relative:
            coordinates = coordinates[:-1] - coordinates[-1]
        self._B = self.strength / TURN * coordinates[:, self.controlled]
        self.shake(phase_noise, coordinates)
        self.occupation_bound = None if self.noisy else math.inf

    def phases(self, x: Tensor) -> Tensor:
        """In relative coordinates the last one is 0."""
        return torch.cat([x, torch.zeros_like(x[:, :1])], dim=-1) if self.relative else x

    def drift(self, x: Tensor) -> Tensor:
        (cosine, sine), A = self.circular(x), self._like(x, "A", self._adjacency)
        # sin(theta_j - theta_i), summed over j, without a matrix for each state.
        pulled = cosine * (sine @ A.T) - sine * (cosine @ A.T)
        rate = (self._like(x, "omega", self._omega) + self.coupling / self.oscillators * pulled) / TURN
        return rate[:, :-1] - rate[:, -1:] if self.relative else rate

    def drift_divergence(self, x: Tensor) -> Tensor:
        """`-(coupling / n) sum_ij A_ij cos(theta_j - theta_i)`, also of the relative phases."""
        (cosine, sine), A = self.circular(x), self._like(x, "A", self._adjacency)
        together = (cosine * (cosine @ A.T) + sine * (sine @ A.T)).sum(dim=-1)
        return -self.coupling / self.oscillators * together

    def control_matrix(self, x: Tensor) -> Tensor:
        return self._like(x, "B", self._B).expand(len(x), -1, -1)

    def control_divergence(self, x: Tensor) -> Tensor:
        return x.new_zeros(len(x), self.control_dim)

    def to_torus(self, phases: Tensor) -> Tensor:
        """In relative coordinates the last phase is taken off."""
        return super().to_torus(phases[:, :-1] - phases[:, -1:] if self.relative else phases)


def _subset(controlled: object, count: int) -> list[int]:
    if controlled is None:
        return list(range(count))
    if isinstance(controlled, str) or not isinstance(controlled, Sequence) or len(controlled) == 0:
        raise InputError(f"problem.controlled is {controlled!r}, but must be a list of oscillators, or null for all.")
    chosen = [require_integer(f"problem.controlled[{i}]", c, 0, maximum=count - 1) for i, c in enumerate(controlled)]
    if len(set(chosen)) < len(chosen):
        raise InputError(f"problem.controlled is {chosen}, but must name each oscillator once.")
    return chosen
