"""Lipschitz constants that a problem declares, held against what its data do change by along lines."""

import torch
from torch import Tensor

from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.problems.blame import named, place
from ocp_torch.problems.lipschitz import Lipschitz
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced

STATES = 2**13  # at which the data are compared; smooth ones are then met within 1e-3 of where they are steepest
DESIGN = 17
STEP = 2.0**-14  # half of the length of a line: longer than rounding shows, shorter than features that are worth a name
EXCESS = 1e-6  # over a constant, relative, that is no contradiction
ROUNDING = 1e-10  # of data, relative to 1 + their size


def missing(problem: Problem) -> list[str]:
    """The data that vary, as ``problem`` overrides them, without a constant of its `lipschitz`."""
    x = torch.full((1, problem.dim), 0.5, dtype=torch.float64)
    unknown = [name for name, constant in vars(problem.lipschitz or Lipschitz()).items() if constant is None]
    return [name for name in unknown if replaced(problem, name, Problem) and getattr(problem, name)(x) is not None]


@torch.no_grad()
def too_small(problem: Problem, odd: Tensor) -> str | None:
    """A constant of the `lipschitz` of ``problem`` that its data exceed, at states spread over the torus or at ``odd``
    ``(K, d)``, in words; `None` where none was met."""
    x = torch.cat([scrambled_sobol(STATES, problem.dim, DESIGN, torch.float64), odd])
    for name, constant in vars(problem.lipschitz or Lipschitz()).items():
        data = getattr(problem, name)
        if constant is None or (value := data(x)) is None:
            continue
        slope, at = steepest(data, x)
        if slope > constant * (1.0 + EXCESS) + ROUNDING * (1.0 + float(value.abs().max())) / STEP:
            return (
                f"{name} changes by {slope:.4g} for each turn of the torus, at {place(at)}, but lipschitz of "
                f"{named(problem)} says {constant:.4g} at most, of turns"
            )
    return None


def steepest(function, x: Tensor) -> tuple[float, Tensor]:
    """The largest `|g(y) - g(z)| / |y - z|` of entries `g` of ``function``, across lines of length `2 STEP` through ``x``
    ``(N, d)``, each along its steepest direction as the axes say; and the state where."""
    across = lambda along: (function(x + STEP * along) - function(x - STEP * along)) / (2.0 * STEP)
    change = lambda along: across(along).reshape(len(x), -1)
    axes = torch.eye(x.shape[1], dtype=x.dtype)
    gradient = torch.stack([change(axis) for axis in axes], dim=-1)  # (N, entries, d)
    best, at = 0.0, x[0]
    for k in range(gradient.shape[1]):
        along = torch.nn.functional.normalize(gradient[:, k], dim=-1)
        slope = change(along)[:, k].abs()
        if float(slope.max()) > best:
            best, at = float(slope.max()), x[int(slope.argmax())]
    return best, at
