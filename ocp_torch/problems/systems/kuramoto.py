r"""Kuramoto's coupled phase oscillators on a graph, some of them pushed: synchronise, desynchronise or entrain them."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_integer, require_number
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.physical.coordinates import Angle
from ocp_torch.problems.systems.graphs import GRAPHS, adjacency
from ocp_torch.problems.systems.oscillators import ENTRAIN, SYNCHRONISE, Oscillators


class Kuramoto(Oscillators):
    r"""`dtheta_i/dt = omega_i + (coupling / n) sum_j A_ij sin(theta_j - theta_i) + p_i`.

    Kuramoto (1975), on a graph as in Rodrigues et al. (Physics Reports 610, 2016). Phases are in radians, ``frequencies``
    `omega` and ``coupling`` in rad/s; pushes `p_i`, with the price `|u|^q / q` of `u = p` in units of ``strength`` rad/s, act
    on those in ``controlled`` (numbers from 0; null: all).
    Cost: ``weight`` times `1 - r^2` to synchronise, `r^2` to desynchronise (`r` the order parameter), or
    `mean_i (1 - cos theta_i) / 2` to entrain, that is to bring all to phase 0.

    ``relative`` phases, to the last one, drop one dimension and lose nothing where the cost depends on
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
        self.strength = require_number("problem.strength", strength, above=0.0)
        last = f" - phase {n - 1}" if self.relative else ""
        phases = [Angle(f"phase {i}{last}") for i in range(n - self.relative)]
        pushes = [f"push {i} [rad/s]" for i in self.controlled]
        super().__init__(
            phases, pushes, discount, exponent, 1.0, control_limit, noise=noise, nominal_control=self.strength
        )
        self.aim(goal, weight)
        self.seed = require_integer("problem.seed", seed, 0)
        self.spread = require_number("problem.spread", spread, at_least=0.0)
        self.probability = require_number("problem.probability", probability, at_least=0.0, at_most=1.0)
        if frequencies is None:
            drawn = torch.randn(n, generator=torch.Generator().manual_seed(self.seed), dtype=torch.float64)
            frequencies = (self.spread * (drawn - drawn.mean())).tolist()
        self.run_at(frequencies, n, coupling)
        self._adjacency = adjacency("problem.graph", graph, n, self.probability, self.seed)
        # Rows, not a file's name: a saved controller must not depend on another file.
        self.graph = graph if graph in GRAPHS else self._adjacency.tolist()
        coordinates = torch.eye(n, dtype=torch.float64)
        if self.relative:
            coordinates = coordinates[:-1] - coordinates[-1]
        self._B = coordinates[:, self.controlled]
        self.shake(phase_noise, coordinates)
        self.occupation_bound = None if self.noisy else math.inf

    def phases(self, s: Tensor) -> Tensor:
        """All phases, ``(N, n)``; in relative coordinates the last one is 0."""
        return torch.cat([s, torch.zeros_like(s[:, :1])], dim=-1) if self.relative else s

    def dynamics(self, s: Tensor) -> tuple[Tensor, Tensor]:
        (cosine, sine), A = self.circular(s), self._like(s, "A", self._adjacency)
        # sin(theta_j - theta_i), summed over j, without a matrix for each state.
        pulled = cosine * (sine @ A.T) - sine * (cosine @ A.T)
        rate = self._like(s, "omega", self._omega) + self.coupling / self.oscillators * pulled
        a = rate[:, :-1] - rate[:, -1:] if self.relative else rate
        return a, self._like(s, "B", self._B).expand(len(s), -1, -1)

    def divergences(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """`div a = -(coupling / n) sum_ij A_ij cos(theta_j - theta_i)`, also for relative phases, and `div B = 0`."""
        (cosine, sine), A = self.circular(s), self._like(s, "A", self._adjacency)
        together = (cosine * (cosine @ A.T) + sine * (sine @ A.T)).sum(dim=-1)
        return -self.coupling / self.oscillators * together, s.new_zeros(len(s), self.control_dim)

    def to_torus(self, s: Tensor) -> Tensor:
        """`System.to_torus`; with relative coordinates also of all `n` phases, from which the last one is then taken off."""
        return super().to_torus(s[:, :-1] - s[:, -1:] if s.shape[1] > self.dim else s)


def _subset(controlled: object, count: int) -> list[int]:
    if controlled is None:
        return list(range(count))
    if isinstance(controlled, str) or not isinstance(controlled, Sequence) or len(controlled) == 0:
        raise InputError(f"problem.controlled is {controlled!r}, but must be a list of oscillators, or null for all.")
    chosen = [require_integer(f"problem.controlled[{i}]", c, 0, maximum=count - 1) for i, c in enumerate(controlled)]
    if len(set(chosen)) < len(chosen):
        raise InputError(f"problem.controlled is {chosen}, but must name each oscillator once.")
    return chosen
