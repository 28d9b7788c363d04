"""Checks that functions depend on each state alone, not on other rows, earlier calls or other threads; have period 1; and
can be differentiated."""

import math
import time

import torch
from torch import Tensor

from ocp_torch.compute.threads import CHUNK, cores, side_by_side
from ocp_torch.errors import ProblemError
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.blame import words
from ocp_torch.problems.checks.functions import MOST_ENTRIES, Functions

# Answers are the same within this part of the largest; rounding in single precision stays below.
SAME = 1e-5
# States of each check, and the numbers of their designs (see `functions.FIRST_DESIGN`).
COMPARED, COMPARED_DESIGN = 37, 1
DIFFERENTIATED, DIFFERENTIATED_DESIGN = 5, 2
TURNED, TURNED_DESIGN = 256, 5
ALONE = (0, 18, 36)  # rows of the compared states that are asked alone too
WHOLE_NUMBERS = (-2, 3)  # smallest and largest number of periods that is added to a coordinate
MOST_SHOWN = 8  # of these numbers in a sentence
# Batches that threads ask for side by side: of functions that keep a state in `self` until they need it again, 19 of 20 times
# that all batches were asked for some answer was wrong.
BATCHES, BATCHES_DESIGN = 16, 10
SECONDS = 0.3  # for which threads go on to ask for these batches
OTHER_ROWS = "is no function of the state alone, but changes with the other states or what was asked before"
TWICE = "is no function of the state alone, but changes when it is asked again"
OVERWRITES = "overwrites an answer it gave before; it must give a new tensor each time"

SIDE_BY_SIDE = (
    "changes when two threads call the functions at once, which concurrent = True allows; leave that out, or let no function "
    "keep anything in self or in a buffer"
)

Answers = tuple[Tensor, dict[str, Tensor]]


def require_purity(functions: Functions) -> Answers:
    """Raise where answers change with the order or number of the states asked; the first answers, for `require_still`."""
    x = functions.exact_states(COMPARED, COMPARED_DESIGN)
    kept = {name: functions.ask(name, x) for name in functions.data}
    first = {name: values.clone() for name, values in kept.items()}
    for name in reversed(functions.data):
        _require_same(functions, name, x, first[name], functions.ask(name, x.flip(0)).flip(0), OTHER_ROWS)
    for name, values in kept.items():
        _require_same(functions, name, x, first[name], values, OVERWRITES)
    for name, values in first.items():
        for row in ALONE:
            one = x[row : row + 1]
            _require_same(functions, name, one, values[row : row + 1], functions.ask(name, one), OTHER_ROWS, values)
    return x, first


def require_still(functions: Functions, first: Answers) -> None:
    """Raise where the answers ``first`` are not given again after some ten thousand other calls."""
    x, answers = first
    for name, values in answers.items():
        _require_same(functions, name, x, values, functions.ask(name, x), TWICE)


def require_concurrency(functions: Functions) -> None:
    """The same answers from threads that ask side by side, where the class says that they may."""
    if functions.simulator or not functions.problem.concurrent or cores() < 2:
        return
    asked = lambda x: {name: functions.ask(name, x) for name in functions.data}
    entries = functions.problem.dim * functions.problem.control_dim
    size = max(1, min(CHUNK, MOST_ENTRIES // (BATCHES * entries)))
    pieces = functions.states(BATCHES * size, BATCHES_DESIGN).split(size)
    alone, until = [asked(x) for x in pieces], time.monotonic() + SECONDS
    while True:
        try:
            together = side_by_side(asked, pieces)
        except ProblemError:  # none was raised by one thread
            raise ProblemError(f"what {functions.name} gives {SIDE_BY_SIDE}.") from None
        for x, one, other in zip(pieces, alone, together, strict=True):
            for name in one:
                _require_same(functions, name, x, one[name], other[name], SIDE_BY_SIDE)
        if time.monotonic() > until:
            return


def require_differentiable(functions: Functions) -> None:
    """Raise where a function cannot be differentiated by the state, as ascents to suprema do."""
    x = functions.states(DIFFERENTIATED, DIFFERENTIATED_DESIGN)
    for name in functions.data:
        function, at = functions.function(name), x.clone()
        with torch.enable_grad():
            answer = functions.called(lambda s, f=function: f(s.requires_grad_(True)), at, name)
            if name == functions.density or not answer.requires_grad:  # nothing differentiates a density
                continue
            try:
                torch.autograd.grad(answer.sum(), at, allow_unused=True)
            except Exception as error:  # whatever the backward pass of a stranger's code may raise
                raise ProblemError(
                    f"{name} of {functions.name} cannot be differentiated by the state, as training and bounds do "
                    f"({words(error)}): use functions that have a derivative in torch, as torch.where(x > 0, 1.0, 0.0) "
                    "for a step, or detach what they are given where the derivative is 0."
                ) from None


def require_period(functions: Functions) -> None:
    """Raise where values change a few whole periods away, in all coordinates at once."""
    x = functions.exact_states(min(TURNED, functions.count), TURNED_DESIGN)
    lowest, highest = WHOLE_NUMBERS
    whole = torch.randint(lowest, highest + 1, x.shape, generator=fixed_generator()).to(x)
    for name in functions.data:
        here = functions.ask(name, x)
        worst, change = worst_of((here - functions.ask(name, x + whole)).abs())
        if not change <= SAME * float(here.abs().max()):
            raise ProblemError(
                f"{name} of {functions.name} is not periodic: at {functions.place(x[worst])} it changes by {change:.3g} when "
                f"the whole numbers {[int(k) for k in whole[worst][:MOST_SHOWN]]} are added to x, but it must have period 1 "
                "in each coordinate; x = x.remainder(1.0) first makes it so."
            )


def _require_same(
    functions: Functions, name: str, x: Tensor, one: Tensor, other: Tensor, how: str, whole: Tensor | None = None
) -> None:
    """Raise where two answers at ``x`` differ, relative to the largest of ``whole`` (``one`` if left out) and ``other``."""
    whole = one if whole is None else whole
    size = float(torch.cat([whole, other]).nan_to_num(0.0, 0.0, 0.0).abs().max())
    alike = (one == other) | (one.isnan() & other.isnan())  # `require_finite` reports these
    worst, change = worst_of(torch.where(alike, 0.0, (one - other).abs()))
    if not change <= SAME * size:
        raise ProblemError(
            f"{name} of {functions.name} {how}: at {functions.place(x[worst])} it differs by {change:.3g}."
        )


def worst_of(changes: Tensor) -> tuple[int, float]:
    """The row of ``changes`` ``(N, ...)`` with the largest entry or a NaN, and that number."""
    change = changes.reshape(len(changes), -1).amax(dim=-1)
    worst = int(change.nan_to_num(nan=math.inf).argmax())
    return worst, float(change[worst])
