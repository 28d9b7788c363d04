"""Values: finite everywhere, `f >= 0` and `mu0 >= 0`, and `f` within the bound that the problem declares."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.errors import ProblemError
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.blame import place
from ocp_torch.problems.checks.functions import DATA, FORMS, Functions

# A part of the largest value that rounding may take a function below 0, or above its bound, by.
ROUNDING = 1e-6
# States for what need not be known everywhere: divergences by autograd and exact truths cost more than data.
FEWER_STATES = 256
# States on faces of the unit cell, at most.
FACES = 32
# The lowest states from which a search goes on downhill, and its steps.
DESCENTS, STEPS = 16, 40
# Designs of the states (see `functions.FIRST_DESIGN`).
SPREAD, FACE, SIGN = 3, 4, 6


def require_finite(functions: Functions) -> None:
    """At evenly spread states and, the data, at those where a division goes wrong first: on the faces and the middles."""
    for dtype in (torch.float64, torch.float32):
        spread = functions.states(functions.count, SPREAD).to(dtype).remainder(1.0)
        special = _special(functions).to(dtype)
        for name in FORMS:
            for x in (spread, special) if name in DATA else (spread[:FEWER_STATES],):
                values = functions.given(name, x)
                if values is None:
                    continue
                bad = ~torch.isfinite(values).reshape(len(x), -1).all(dim=-1)
                if bool(bad.any()):
                    at = int(bad.nonzero()[0])
                    how = " in single precision" if dtype is torch.float32 else ""
                    raise ProblemError(
                        f"{name} of {functions.name} gives {values[at].tolist()}{how} at {place(x[at])}, but must be finite "
                        "on the whole torus."
                    )


def _special(functions: Functions) -> Tensor:
    """Quarters of the diagonal, and states with one coordinate at 0 or 1/2; ``(K, d)``."""
    d = functions.problem.dim
    corners = torch.tensor([0.0, 0.5, 0.25, 0.75], dtype=torch.float64).unsqueeze(-1).expand(4, d)
    faces = functions.states(min(FACES, functions.count), FACE)
    rows = torch.arange(len(faces))
    faces[rows, rows % d] = 0.5 * (rows % 2).double()
    return torch.cat([corners, faces])


def require_signs(functions: Functions) -> None:
    """`f >= 0` and `mu0 >= 0`, at states and downhill from the least; and `f` within the bound the problem declares."""
    x = functions.states(functions.count, SIGN)
    largest, at = _require_sign(functions, "state_cost", x, "; a constant added to it changes no optimal control.")
    bound = functions.problem.state_cost_bound
    if bound is not None and not largest <= bound + ROUNDING * abs(largest):
        raise ProblemError(
            f"state_cost of {functions.name} is {largest:.6g} at {place(at)}, above its state_cost_bound = "
            f"{float(bound):.6g}."
        )
    _require_sign(functions, "initial_density", x, ".")


def _require_sign(functions: Functions, name: str, x: Tensor, hint: str) -> tuple[float, Tensor]:
    """The function ``name`` is not negative; the largest size of its values at ``x``, and where it is largest."""
    function = getattr(functions.problem, name)
    values = functions.ask(name, x)
    lowest = x[values.topk(min(DESCENTS, len(x)), largest=False).indices]
    found = supremum(lambda at: -function(at), lowest, ascents=DESCENTS, steps=STEPS, differentiable=False)
    least, largest = -found.value, float(values.abs().max())
    if not least >= -ROUNDING * largest:
        raise ProblemError(
            f"{name} of {functions.name} is {least:.6g} at {place(found.x)}, but must be at least 0{hint}"
        )
    return largest, x[int(values.argmax())]
