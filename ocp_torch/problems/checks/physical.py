"""Checks of what a user writes of a `System`, `cost`, `dynamics` and `disturbance`, in the user's own names and units."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ocp_torch.errors import ProblemError
from ocp_torch.problems.checks.functions import Functions
from ocp_torch.problems.checks.sameness import SAME, worst_of
from ocp_torch.problems.physical.coordinates import Angle
from ocp_torch.problems.physical.system import System

# Names of the functions in messages.
COST = "cost"
DRIFT = "a of dynamics"
MATRIX = "B of dynamics"
NOISE = "disturbance"
# States that are compared a turn apart, and the number of their design (see `functions.FIRST_DESIGN`).
TURNED, TURNED_DESIGN = 256, 8


class SystemFunctions(Functions):
    """The functions of a ``system`` in physical units, as functions of states on the torus."""

    cost, density, sigma = COST, "", NOISE
    own_forms = own_data = {COST: "", DRIFT: "d", MATRIX: "dm"}
    spread, where = {}, "in the box and its margins"

    def __init__(self, system: System) -> None:
        self.system = system
        super().__init__(system, simulator=False)

    def function(self, name: str) -> Callable[[Tensor], Any]:
        physical, whose = self.physical(name), "dynamics" if name in (DRIFT, MATRIX) else name

        def asked(x: Tensor) -> Any:
            answer = physical(given := (s := self.system.from_torus(x)).clone())
            if not torch.equal(given, s):
                raise ProblemError(
                    f"{whose} of {self.name} changes its argument s in place; it must leave it (s = s.clone() first)."
                )
            return answer

        return asked

    def physical(self, name: str) -> Callable[[Tensor], Any]:
        """The function ``name`` of physical states."""
        if name in (DRIFT, MATRIX):
            return lambda s: self._pair(s)[name == MATRIX]
        return self.system.cost if name == COST else self.system.disturbance

    def _pair(self, s: Tensor) -> tuple[Tensor, Tensor]:
        pair = self.system.dynamics(s)
        if not isinstance(pair, tuple | list) or len(pair) != 2:
            raise ProblemError(
                f"dynamics of {self.name} gave a {type(pair).__name__}, but must give two tensors, a of shape (N, d) and B "
                "of shape (N, d, m)."
            )
        return pair[0], pair[1]


def require_turns(functions: SystemFunctions) -> None:
    """Raise where a function changes when an angle goes on by a whole turn."""
    system = functions.system
    s = system.from_torus(functions.states(min(TURNED, functions.count), TURNED_DESIGN))
    for i, c in enumerate(system.coordinates):
        if not isinstance(c, Angle):
            continue
        turned = s.clone()
        turned[:, i] += c.length
        for name in functions.data:
            function = functions.physical(name)
            here, there = function(s.clone()), function(turned.clone())
            row, change = worst_of((here - there).abs())
            if not change <= SAME * float(here.abs().max()):
                raise ProblemError(
                    f"{name} of {functions.name} changes by {change:.3g} when {c.name} goes on by a turn of {c.length:.6g} "
                    f"{c.unit}, at {system.chart.place(s[row])}, but an angle has no preferred turn: use its sine and cosine."
                )
