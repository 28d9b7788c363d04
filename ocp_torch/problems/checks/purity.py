"""A function of each state alone: not of the other rows, nor of what was asked before, and one that autograd may call."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ocp_torch.errors import ProblemError
from ocp_torch.problems.blame import place
from ocp_torch.problems.checks.functions import DATA, Functions

# Answers that differ by more than that part of the largest are not the same; rounding in single precision stays below.
SAME = 1e-5
# States compared, some rows of them asked alone, and their designs (see `functions.FIRST_DESIGN`).
COMPARED, ALONE, DESIGN = 37, (0, 18, 36), 1
DIFFERENTIATED, DIFFERENTIATED_DESIGN = 5, 2
OTHER_ROWS = "is no function of the state alone, but changes with the other states or what was asked before"
TWICE = "is no function of the state alone, but changes when it is asked again"
OVERWRITES = "overwrites an answer it gave before; it must give a new tensor each time"

Answers = tuple[Tensor, dict[str, Tensor]]


def require_purity(functions: Functions) -> Answers:
    """Ask the same states in another order, among others and alone; what was answered first is given for `require_still`."""
    x = functions.exact_states(COMPARED, DESIGN)
    kept = {name: functions.ask(name, x) for name in DATA}
    first = {name: values.clone() for name, values in kept.items()}
    turned = x.flip(0)
    for name in reversed(DATA):
        _require_same(functions, name, x, first[name], functions.ask(name, turned).flip(0), OTHER_ROWS)
    for name, values in kept.items():
        _require_same(functions, name, x, first[name], values, OVERWRITES)
    for name in DATA:
        for row in ALONE:
            part = slice(row, row + 1)
            alone = functions.ask(name, x[part])
            _require_same(functions, name, x[part], first[name][part], alone, OTHER_ROWS, first[name])
    return x, first


def require_still(functions: Functions, first: Answers) -> None:
    """The same answers again, after some ten thousand others."""
    x, answers = first
    for name, values in answers.items():
        _require_same(functions, name, x, values, functions.ask(name, x), TWICE)


def require_differentiable(functions: Functions) -> None:
    """It can be called with states that need gradients: ascents to suprema differentiate by the state."""
    x = functions.states(DIFFERENTIATED, DIFFERENTIATED_DESIGN)
    for name in DATA:
        with torch.enable_grad():
            function = getattr(functions.problem, name)
            functions.called(lambda at, f=function: f(at.requires_grad_(True)), x.clone(), name)


def _require_same(
    functions: Functions, name: str, x: Tensor, one: Tensor, other: Tensor, how: str, whole: Tensor | None = None
) -> None:
    """Raise where two answers at ``x`` differ, relative to the largest of ``whole`` (``one`` if left out) and ``other``."""
    whole = one if whole is None else whole
    size = float(torch.cat([whole, other]).nan_to_num(0.0, 0.0, 0.0).abs().max())
    alike = (one == other) | (one.isnan() & other.isnan())  # what is not finite is told elsewhere
    change = torch.where(alike, 0.0, (one - other).abs()).reshape(len(x), -1).amax(dim=-1)
    worst = int(change.nan_to_num(nan=math.inf).argmax())
    if not float(change[worst]) <= SAME * size:
        raise ProblemError(f"{name} of {functions.name} {how}: at {place(x[worst])} it differs by {change[worst]:.3g}.")
