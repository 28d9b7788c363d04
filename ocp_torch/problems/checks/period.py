"""Period 1 in each coordinate, at states to which whole numbers are added without rounding."""

from __future__ import annotations

import math

import torch

from ocp_torch.errors import ProblemError
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.blame import place
from ocp_torch.problems.checks.functions import DATA, Functions
from ocp_torch.problems.checks.purity import SAME

# States compared, their design (see `functions.FIRST_DESIGN`), and the whole numbers that are added to them.
COMPARED, DESIGN = 256, 5
LOWEST, HIGHEST = -2, 3
# Coordinates that a sentence shows.
MOST_SHOWN = 8


def require_period(functions: Functions) -> None:
    """The same values a few whole periods away, in all coordinates at once."""
    x = functions.exact_states(min(COMPARED, functions.count), DESIGN)
    whole = torch.randint(LOWEST, HIGHEST + 1, x.shape, generator=fixed_generator()).to(x)
    for name in DATA:
        here, there = functions.ask(name, x), functions.ask(name, x + whole)
        change = (here - there).abs().reshape(len(x), -1).amax(dim=-1)
        worst = int(change.nan_to_num(nan=math.inf).argmax())
        if not float(change[worst]) <= SAME * float(here.abs().max()):
            raise ProblemError(
                f"{name} of {functions.name} is not periodic: at {place(x[worst])} it changes by {change[worst]:.3g} when "
                f"the whole numbers {[int(k) for k in whole[worst][:MOST_SHOWN]]} are added to x, but it must have period 1 "
                "in each coordinate; x = x.remainder(1.0) first makes it so."
            )
