"""What is called a divergence is one: held against central differences, where those of two steps agree."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.errors import ProblemError
from ocp_torch.problems.blame import place
from ocp_torch.problems.checks.functions import Functions

SOURCES = {"drift_divergence": "drift", "control_divergence": "control_matrix"}
# States compared, and their design (see `functions.FIRST_DESIGN`).
COMPARED, DESIGN = 24, 7
# Steps of the differences. They are believed where both agree within this part of the largest divergence, and a claim that is
# off by more than that part there is wrong; kinks and jumps at a minority of states are forgiven.
STEPS, AGREE, WRONG = (1e-3, 2.5e-4), 0.01, 0.1
# Beyond so many numbers the differences cost too much.
MOST_NUMBERS = 2**24


def require_divergences(functions: Functions) -> None:
    """Raise where most of the divergences that differences settle are claimed to be something else."""
    d, m = functions.problem.dim, functions.problem.control_dim
    if functions.simulator or COMPARED * d * d * m > MOST_NUMBERS:
        return
    x = functions.exact_states(COMPARED, DESIGN)
    for name, source in SOURCES.items():
        claimed = functions.given(name, x)
        if claimed is None:
            continue
        claimed = claimed.reshape(len(x), -1)
        coarse, fine = (_differences(functions, source, x, step) for step in STEPS)
        size = float(torch.maximum(fine.abs(), claimed.abs()).max())
        settled = ((coarse - fine).abs() <= AGREE * size).all(dim=-1)
        off = (claimed - fine).abs().amax(dim=-1)
        wrong = settled & (off > WRONG * size)
        if 2 * int(settled.sum()) > len(x) and 2 * int(wrong.sum()) > int(settled.sum()):
            at = int((off * wrong).argmax())
            raise ProblemError(
                f"{name} of {functions.name} is {_listed(claimed[at])} at {place(x[at])}, but by differences of {source} it "
                f"is {_listed(fine[at])}; give the divergence of {source}, or None where it is not known (as where "
                f"{source} detaches x or leaves PyTorch, which loses its derivative)."
            )


def _differences(functions: Functions, source: str, x: Tensor, step: float) -> Tensor:
    """The divergence of each column, ``(N, columns)``, by central differences."""
    total = torch.zeros((), dtype=x.dtype)
    for i in range(x.shape[1]):
        moved = torch.zeros_like(x)
        moved[:, i] = step
        change = (functions.ask(source, x + moved) - functions.ask(source, x - moved)) / (2.0 * step)
        total = total + change.reshape(*x.shape, -1)[:, i]
    return total


def _listed(values: Tensor) -> str:
    return f"{float(values[0]):.4g}" if len(values) == 1 else str([round(float(v), 6) for v in values[:8]])
