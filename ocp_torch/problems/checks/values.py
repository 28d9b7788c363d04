"""Checks of values: finite; `f` and `mu0` not negative; `f` within its declared bound; noise complete; divergences right."""

from functools import partial

import torch
from torch import Tensor

from ocp_torch.errors import ProblemError
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.checks.functions import DIV_D, DIV_DIV_D, NOISE, Functions
from ocp_torch.problems.problem import Problem, shipped

# Rounding may take a function below 0, or above its bound, by this part of its largest value.
ROUNDING = 1e-6
# States at which divergences and exact truths must be finite: autograd makes them dearer than the data.
FEWER_STATES = 256
# States on faces of the unit cell, at most.
FACES = 32
DESCENTS = 16  # from the lowest of the sampled states, in search of values below 0
DESCENT_STEPS = 40
# Numbers of the designs of states, one for each check (see `functions.FIRST_DESIGN`).
FINITE_DESIGN = 3
FACE_DESIGN = 4
SIGN_DESIGN = 6
DIVERGENCE_DESIGN = 7
NOISE_DESIGN = 8
# Divergence -> the field that it must be the divergence of.
D = "D = noise noise^T / 2"
SOURCES = {"drift_divergence": "drift", "control_divergence": "control_matrix", DIV_D: D, DIV_DIV_D: DIV_D}
# States at which claimed divergences are compared with central differences, and at which noise is compared.
COMPARED = 24
DIFFERENCES = (1e-3, 2.5e-4)  # the two steps of the central differences
AGREE = 0.01  # part of the largest divergence within which both steps must agree to say anything at a state
# A claim is wrong at such a state if its error is above all three of these.
RELATIVE_ERROR = 0.1  # times the larger of the claim and the difference there
ERROR_OVER_SPREAD = 10.0  # times what the two steps differ by
LEAST_ERROR = 1e-3  # times the largest divergence anywhere
# The divergences are not checked where the differences would take more numbers than this.
MOST_NUMBERS = 2**24


def require_finite(functions: Functions) -> None:
    """Raise where a function is not finite: at evenly spread states, and for the data also where divisions go wrong first."""
    for dtype, how in ((torch.float64, ""), (torch.float32, " in single precision")):
        spread = functions.states(functions.count, FINITE_DESIGN).to(dtype).remainder(1.0)
        special = _special(functions).to(dtype)
        for name in functions.forms:
            for x in (spread, special) if name in functions.data else (spread[:FEWER_STATES],):
                values = functions.given(name, x)
                if values is None:
                    continue
                bad = ~torch.isfinite(values).reshape(len(x), -1).all(dim=-1)
                if bool(bad.any()):
                    at = int(bad.nonzero()[0])
                    raise ProblemError(
                        f"{name} of {functions.name} gives {values[at].tolist()}{how} at {functions.place(x[at])}, but must "
                        f"be finite {functions.where}."
                    )


def _special(functions: Functions) -> Tensor:
    """Quarters of the diagonal, and states with one coordinate at 0 or 1/2; ``(K, d)``."""
    d = functions.problem.dim
    corners = torch.tensor([0.0, 0.5, 0.25, 0.75], dtype=torch.float64).unsqueeze(-1).expand(4, d)
    faces = functions.states(min(FACES, functions.count), FACE_DESIGN)
    rows = torch.arange(len(faces))
    faces[rows, rows % d] = 0.5 * (rows % 2).double()
    return torch.cat([corners, faces])


def require_signs(functions: Functions) -> None:
    """Raise where `f` or `mu0` is below 0, at states or downhill from the least, or `f` is above its declared bound."""
    x = functions.states(functions.count, SIGN_DESIGN)
    largest, at = _require_sign(functions, functions.cost, x, "; a constant added to it changes no optimal control.")
    bound = functions.problem.state_cost_bound
    if bound is not None and not largest <= bound + ROUNDING * abs(largest):
        raise ProblemError(
            f"{functions.cost} of {functions.name} is {largest:.6g} at {functions.place(at)}, above its state_cost_bound = "
            f"{float(bound):.6g}."
        )
    if functions.density:
        _require_sign(functions, functions.density, x, ".")


def _require_sign(functions: Functions, name: str, x: Tensor, hint: str) -> tuple[float, Tensor]:
    """Raise where the function ``name`` is below 0; its largest absolute value at ``x``, and where its value is largest."""
    function = functions.function(name)
    values = functions.ask(name, x)
    lowest = x[values.topk(min(DESCENTS, len(x)), largest=False).indices]
    found = supremum(lambda at: -function(at), lowest, ascents=DESCENTS, steps=DESCENT_STEPS, differentiable=False)
    least, largest = -found.value, float(values.abs().max())
    if not least >= -ROUNDING * largest:
        raise ProblemError(
            f"{name} of {functions.name} is {least:.6g} at {functions.place(found.x)}, but must be at least 0{hint}"
        )
    return largest, x[int(values.argmax())]


def require_kept_noise(functions: Functions) -> None:
    """Raise where an override of `noise` has less `sigma sigma^T` than the numbers and columns given to `Problem`."""
    problem, x = functions.problem, functions.states(COMPARED, NOISE_DESIGN)
    owner = next(kind for kind in type(problem).__mro__ if "noise" in vars(kind))
    given = Problem.noise(problem, x)
    if given is None or (shipped(owner) and "noise" not in vars(problem)):
        return
    square = given @ given.mT
    own = functions.ask(NOISE, x) if functions.noisy else torch.zeros_like(given)
    least = torch.linalg.eigvalsh(own @ own.mT - square)[:, 0]
    if float(least.min()) < -ROUNDING * float(square.abs().max()):
        raise ProblemError(
            f"noise(x) of {functions.name} leaves out the noise that its __init__ gives to super().__init__(noise=..) or "
            f"add_noise, at {functions.place(x[int(least.argmin())])} for one; it must hold the columns of super().noise(x) "
            "beside its own (torch.cat(.., dim=-1)), or nothing must be given there."
        )


def require_divergences(functions: Functions) -> None:
    """Raise where a claimed divergence is wrong at most of the states at which central differences of two steps agree; kinks
    and jumps at a minority of states are forgiven."""
    d, m = functions.problem.dim, functions.problem.control_dim
    if functions.simulator or COMPARED * d * d * max(m, d * functions.noisy) > MOST_NUMBERS:
        return
    x = functions.exact_states(COMPARED, DIVERGENCE_DESIGN)
    for name, source in SOURCES.items():
        if name not in functions.forms:
            continue
        claimed = functions.given(name, x)
        if claimed is None:
            continue
        claimed = claimed.reshape(len(x), -1)
        coarse, fine = (_differences(functions, source, x, step) for step in DIFFERENCES)
        sizes = torch.maximum(fine.abs(), claimed.abs()).amax(dim=-1)  # a system's are largest beyond its box
        size, apart = float(sizes.max()), (coarse - fine).abs().amax(dim=-1)
        settled, off = apart <= AGREE * size, (claimed - fine).abs().amax(dim=-1)
        wrong = (
            settled & (off > RELATIVE_ERROR * sizes) & (off > ERROR_OVER_SPREAD * apart) & (off > LEAST_ERROR * size)
        )
        if 2 * int(settled.sum()) > len(x) and 2 * int(wrong.sum()) > int(settled.sum()):
            at = int((off * wrong).argmax())
            raise ProblemError(
                f"{name} of {functions.name} is {_listed(claimed[at])} at {functions.place(x[at])}, but by differences of "
                f"{source} it is {_listed(fine[at])}; give the divergence of {source}, or None where it is not known (as "
                f"where {source} detaches x or leaves PyTorch, which loses its derivative)."
            )


def _differences(functions: Functions, source: str, x: Tensor, step: float) -> Tensor:
    """The divergence of each column of ``source``, ``(N, columns)``, by central differences."""
    ask = partial(_diffusion, functions) if source == D else partial(functions.ask, source)
    total = torch.zeros((), dtype=x.dtype)
    for i, move in enumerate(step * torch.eye(x.shape[1], dtype=x.dtype)):
        change = (ask(x + move) - ask(x - move)) / (2.0 * step)
        total = total + change.reshape(*x.shape, -1)[:, i]
    return total


def _diffusion(functions: Functions, x: Tensor) -> Tensor:
    sigma = functions.ask(NOISE, x)
    return 0.5 * sigma @ sigma.mT


def _listed(values: Tensor) -> str:
    return f"{float(values[0]):.4g}" if len(values) == 1 else str([round(float(v), 6) for v in values[:8]])
