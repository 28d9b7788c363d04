"""All checks of a problem, the cheap ones first. Every failure is one sentence with function, shape or state.

What is refused is certainly wrong. Rough and discontinuous functions are legal, so answers are compared only at states that
are the same to the bit, in single precision too, and away from where functions like to jump.
"""

from __future__ import annotations

import torch

from ocp_torch.problems.checks.construction import require_made, require_units
from ocp_torch.problems.checks.divergences import require_divergences
from ocp_torch.problems.checks.functions import FORMS, Functions
from ocp_torch.problems.checks.mass import require_mass
from ocp_torch.problems.checks.period import require_period
from ocp_torch.problems.checks.purity import require_differentiable, require_purity, require_still
from ocp_torch.problems.checks.values import require_finite, require_signs
from ocp_torch.problems.problem import Problem

# Sizes of the batches that shapes are checked with: none a likely d or m, and one a single state.
SIZES = (7, 1, 37, 2)


def check_once(problem: Problem) -> None:
    """Raise `InputError` where ``problem`` is not what `Problem` says one is; costs some ten thousand evaluations.

    The package's own classes are tested instead, and a data set has checks of its own.
    """
    require_made(problem)
    if not problem.has_simulator:
        return
    own = type(problem).__module__.startswith("ocp_torch.")
    simulator = hasattr(problem, "answers")
    if simulator or not own:
        with torch.random.fork_rng(devices=[]), torch.no_grad():
            _check(Functions(problem, simulator))
    require_units(problem)


def _check(functions: Functions) -> None:
    for dtype in (torch.float64, torch.float32):
        for size in SIZES:
            x = functions.states(size).to(dtype)
            for name in FORMS:
                functions.given(name, x)
    first = require_purity(functions)
    if not functions.simulator:
        require_differentiable(functions)
    for require in (require_finite, require_period, require_signs, require_divergences, require_mass):
        require(functions)
    require_still(functions, first)
