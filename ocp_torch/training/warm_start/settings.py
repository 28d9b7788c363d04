"""The settings of the warm start, validated where they are made, and for which problems it runs."""

import math
from dataclasses import dataclass

from ocp_torch.errors import InputError, require_choice, require_integer, require_number
from ocp_torch.fields import VALUE
from ocp_torch.objectives import Objective
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.equilibrium import equilibrium
from ocp_torch.problems.simulator.simulator import Simulator

OFF, ON, AUTO = "off", "on", "auto"


@dataclass(frozen=True)
class WarmStartSettings:
    """Whether a run begins with value iteration, and how. Raises `InputError` on a wrong value."""

    mode: str  # off, on, or auto: where `pays` says so
    rounds: int  # at most
    pieces: int  # of trajectory, in each round
    steps: int  # of each piece
    trace: float  # lambda of the returns

    def __post_init__(self) -> None:
        require_choice("warm_start.mode", self.mode, (OFF, ON, AUTO))
        for name, least, most in (("rounds", 1, 10**6), ("pieces", 8, 2**20), ("steps", 1, 10**4)):
            require_integer(f"warm_start.{name}", getattr(self, name), least, maximum=most)
        require_number("warm_start.trace", self.trace, at_least=0.0, at_most=1.0)

    def wanted(self, problem: Problem, objective: Objective, constants: Constants) -> bool:
        """Whether a run of ``objective`` on ``problem`` is to begin with value iteration. Raises `InputError` where that is
        ``on`` and impossible."""
        possible = problem.has_simulator and VALUE in objective.fields
        if self.mode == ON and not possible:
            lacks = "this method has no V" if problem.has_simulator else "a data set cannot be simulated"
            raise InputError(f"warm_start.mode is on, but {lacks}; use off or auto.")
        return possible and (self.mode == ON or (self.mode == AUTO and pays(problem, constants)))


def pays(problem: Problem, constants: Constants) -> bool:
    """Whether good controllers are likely to come late without a warm start, as in swing-ups: mass gathers, or would without
    noise, there is drift and more coordinates than controls, and these are limited. Never for a simulator, whose evaluations
    may be dear. A warm start that finds nothing better than doing nothing is not used."""
    underactuated = not problem.driftless and problem.control_dim < problem.dim
    if not underactuated or math.isinf(problem.control_cost.reach) or isinstance(problem, Simulator):
        return False
    rest = equilibrium(problem)
    return constants.unbounded or (rest is not None and rest.gathers)
