"""Derivatives by the state: what autograd says that the data change by is what they do change by."""

from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ocp_torch.errors import ProblemError
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import value_and_gradient
from ocp_torch.problems.checks.functions import Functions
from ocp_torch.problems.checks.values import (
    AGREE,
    COMPARED,
    DIFFERENCES,
    ERROR_OVER_SPREAD,
    LEAST_ERROR,
    RELATIVE_ERROR,
)

SLOPE_DESIGN = 9  # of the states (see `functions.FIRST_DESIGN`)
# Part of the states where something changes that may be at odds, as a function may be asked right beside a kink. Where most
# states settle nothing, as of a rough function, nothing is said.
FORGIVEN = 0.25
# The step of differences that acquit a claim: a rough function may change by its derivative over no more than this. Sums of
# cosines with up to five million waves a turn, and a hash, were refused without them.
SMALLEST_DIFFERENCE = 1e-8


def require_slopes(functions: Functions) -> None:
    """Raise where autograd has lost the derivative of data along lines, which central differences of two steps settle: bounds
    climb to suprema by it. Steps pass, as their derivative is 0 where a difference does not straddle one; data with a step in
    nearly every difference, as a cost rounded to five digits, do not."""
    if functions.simulator:  # whose own are differences
        return
    x, draw = functions.exact_states(COMPARED, SLOPE_DESIGN), partial(torch.randn, generator=fixed_generator())
    along = normalize(draw(x.shape, dtype=x.dtype))
    for name in functions.data:
        if name == functions.density:  # nothing differentiates a density
            continue
        weights = draw(functions.ask(name, x).shape[1:], dtype=x.dtype)
        mixed = lambda at, name=name, weights=weights: (functions.ask(name, at) * weights).flatten(1).sum(dim=-1)
        scalar = mixed if weights.ndim else lambda at, name=name: functions.ask(name, at)
        claimed = (value_and_gradient(scalar, x)[1] * along).sum(dim=-1)
        coarse, fine, finest = (
            _change(scalar, x, step * along) / (2.0 * step) for step in (*DIFFERENCES, SMALLEST_DIFFERENCE)
        )
        sizes, apart, off = torch.maximum(fine.abs(), claimed.abs()), (coarse - fine).abs(), (claimed - fine).abs()
        settled, some = apart <= AGREE * sizes.max(), sizes > LEAST_ERROR * sizes.max()
        wrong = settled & some & (off > RELATIVE_ERROR * sizes) & (off > ERROR_OVER_SPREAD * apart)
        wrong &= (claimed - finest).abs() >= RELATIVE_ERROR * claimed.abs()  # a claim of 0 is never acquitted
        if 2 * int(settled.sum()) > len(x) and int(wrong.sum()) > FORGIVEN * int((settled & some).sum()):
            at = int((off * wrong).argmax())
            raise ProblemError(
                f"{name} of {functions.name} loses its derivative by the state: at {functions.place(x[at])} it changes by "
                f"{float(fine[at]):.3g} for each turn of the torus along a line, and by {float(claimed[at]):.3g} as autograd "
                "says; PyTorch must see all of it, as bounds climb to suprema by it (without NumPy, .detach() and no_grad; "
                "problem=callable takes a simulator in NumPy)."
            )


def _change(function, x: Tensor, half: Tensor) -> Tensor:
    return function(x + half) - function(x - half)
