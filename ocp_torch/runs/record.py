"""Record a problem: draw states, evaluate, write the file that `problem=dataset` trains on."""

import logging
from pathlib import Path

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_flag, require_integer, require_number
from ocp_torch.files.limits import require_memory
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.problems.recorded import recording
from ocp_torch.problems.samples import Samples
from ocp_torch.runs.build import build_problem

log = logging.getLogger(__name__)

# States evaluated at once, which bounds the memory.
CHUNK = 4096


def arguments(config: dict) -> dict:
    """The arguments of `record` that the plain ``config`` names, checked. Raises `InputError` for a wrong field."""
    problem = build_problem(config["problem"])
    if not problem.has_simulator:
        raise InputError("problem is a data set already; there is nothing to record from it.")
    out = Path(str(config["out"]))
    if out.suffix not in recording.SUFFIXES:
        raise InputError(f"out is {str(out)!r}, but must end in {' or '.join(recording.SUFFIXES)}.")
    wanted, unknown = require_flag("divergences", config["divergences"]), problem.unknown_divergences
    if wanted and unknown:
        log.warning("warning: no divergences are recorded, as this problem gives none of %s.", unknown)
    count = require_integer("samples", config["samples"], recording.FEWEST, maximum=10**8)
    d, m = problem.dim, problem.control_dim
    sigma = problem.noise(torch.full((1, d), 0.5, dtype=torch.float64))
    spread = 0 if sigma is None else sigma.numel() + d + 1
    require_memory("samples", count, 8 * (2 * d + d * m + m + 3 + spread))  # all columns and divergences in float64
    return {
        "problem": problem,
        "count": count,
        "out": out,
        "seed": require_integer("seed", config["seed"], 0),
        "divergences": wanted and not unknown,
        "contrast": require_number("contrast", config["contrast"], at_least=0.0, at_most=0.95),
    }


def record(problem: Problem, count: int, out: Path, seed: int, divergences: bool, contrast: float) -> Path:
    """Write ``count`` independent samples of ``problem`` into the file ``out``.

    States are uniform, or, with ``contrast`` `k` in (0, 1), of density `prod_i (1 + k cos(2 pi x_i))`, which is recorded.
    """
    x = _states(count, problem.dim, seed, contrast)
    parts = [Samples.of(problem, part, divergences=divergences) for part in x.split(CHUNK)]
    numbers = {name: getattr(problem, name) for name in ("discount", "exponent", "control_limit")}
    density = None if contrast == 0.0 else _relative_density(x, contrast).prod(dim=-1)
    recording.write(out, Samples.concatenate(parts), numbers, density, problem.measures)
    log.info("%s samples of d = %d, m = %d in %s", f"{count:,}", problem.dim, problem.control_dim, out)
    return out


def _relative_density(x: Tensor, contrast: float) -> Tensor:
    return 1.0 + contrast * (2.0 * torch.pi * x).cos()


def _states(count: int, dim: int, seed: int, contrast: float) -> Tensor:
    """Independent states: uniform, or by rejection, coordinate by coordinate."""
    generator = torch.Generator().manual_seed(derive_seed(seed, Branch.RECORDING))
    draw = lambda *shape: torch.rand(*shape, dtype=torch.float64, generator=generator)
    x = draw(count, dim)
    wrong = torch.full(x.shape, contrast > 0.0)
    while wrong.any():
        fresh = draw(int(wrong.sum()))
        kept = draw(len(fresh)) * (1.0 + contrast) <= _relative_density(fresh, contrast)
        at = wrong.nonzero()[kept]
        x[at[:, 0], at[:, 1]] = fresh[kept]
        wrong[at[:, 0], at[:, 1]] = False
    return x
