"""Controllers from their files, of which no code is run and whose contents are checked."""

from collections.abc import Callable
from pathlib import Path

import torch

from ocp_torch.control.controller import SAVED, SCHEMA, Controller
from ocp_torch.control.described import problem_name, require_same
from ocp_torch.control.policies import CLOSED, NETWORK, SADDLE
from ocp_torch.errors import InputError, notes
from ocp_torch.fields import CONTROL_DENSITY, LOG_OCCUPATION, MODELS, SUBSOLUTION, TRAJECTORY_VALUE, VALUE, Fields, made
from ocp_torch.files.limits import require_held, require_modest_problem
from ocp_torch.files.reading import FILE, FOLDER, kind, require_path
from ocp_torch.files.storage import load_tensors
from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.checks.check import check_once
from ocp_torch.problems.commands import ForeignProblem, current_name, current_section, made_by, naming
from ocp_torch.problems.constants import Constants

FILE_NAME = "controller.safetensors"  # of a run's controller
# The networks that a file may hold.
FIELDS = (VALUE, CONTROL_DENSITY, LOG_OCCUPATION, TRAJECTORY_VALUE, SUBSOLUTION)
WORST = f"networks.{SUBSOLUTION}.worst"  # the states that come with a subsolution, as many as the file has


def controller_file(path: Path) -> Path:
    """The file of the controller that ``path`` names: itself, or that of a run's folder, or of the newest run in a folder."""
    if kind(path) != FOLDER or kind(path / FILE_NAME) is not None:
        return path / FILE_NAME if kind(path) == FOLDER else path
    inside = [file for file in path.glob(f"*/{FILE_NAME}") if kind(file) == FILE]
    return max(inside, key=lambda file: file.stat().st_mtime, default=path / FILE_NAME)


def load_controller(path: str | Path, problem: Problem | None = None, device: str = "cpu") -> Controller:
    """Load a controller saved by a run, by its file, its run's folder, or a folder of runs (that of the newest run); no code
    in the file is run.

    A controller of one of the package's problems rebuilds it from its parameters; one of a user's own problem needs that
    ``problem``, made with the same arguments. Raises `InputError` when the file is missing, damaged, of a newer schema, or
    does not fit the problem.
    """
    path = controller_file(require_path("path", path))
    tensors, metadata = load_tensors(path)
    schema = metadata.get("schema")
    if not isinstance(schema, int) or schema > SCHEMA:
        raise InputError(f"{path} has schema {schema!r}, but this version of ocp_torch reads up to {SCHEMA}.")
    try:
        return _rebuilt(path, tensors, metadata, problem, device)
    except (KeyError, TypeError, AttributeError, RuntimeError, ValueError, ArithmeticError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} does not describe a controller ({type(error).__name__}: {error}).") from None


def _rebuilt(path: Path, tensors: dict, metadata: dict, problem: Problem | None, device: str) -> Controller:
    if metadata["occupation"] not in (None, CLOSED, SADDLE, NETWORK):
        raise InputError(f"{path} names the unknown occupation {metadata['occupation']!r}.")
    _require_run(path, metadata["certificate"], metadata["config"])
    problem = _problem_of(path, metadata, problem)
    build = _networks_of(path, tensors, metadata, problem)
    with torch.device("meta"):
        # Shapes first, without memory: a crafted size must not be allocated before it is refused.
        shapes = {name: t.shape for name, t in build().state_dict().items()}
    if shapes != {name: t.shape for name, t in tensors.items()}:
        fit = f"its weights are not those of its model on a problem of dimension {problem.dim}"
        raise InputError(f"{path} does not fit: {fit}.")
    require_same(path, problem, metadata["problem"])
    _require_weights(path, tensors, metadata["dtype"])
    with torch.random.fork_rng(devices=[]):
        fields = build().to(dtype=getattr(torch, metadata["dtype"]))
    fields.load_state_dict(tensors)
    fields = fields.to(device).requires_grad_(False)
    constants = Constants(**{**metadata["bounds"], "warnings": notes(metadata["bounds"]["warnings"])})
    return Controller(problem, fields, constants, **{name: metadata[name] for name in SAVED})


def _problem_of(path: Path, metadata: dict, problem: Problem | None) -> Problem:
    """The problem that ``metadata`` describes: the given one, if it may be that, or one of the package's."""
    saved = metadata["problem"]
    if problem is None:
        if saved["name"] not in PROBLEMS:
            section = _section(saved, metadata["config"])
            raise ForeignProblem(
                f"{path} belongs to the problem {str(saved['name'])[:80]!r}, which is not part of ocp_torch, or calls a "
                f"function of yours; pass it: load_controller(path, problem={made_by(section)}).",
                naming(section),
            )
        require_modest_problem(path, saved["parameters"], "pass it: load_controller(path, problem=...)")
        return PROBLEMS[saved["name"]](**saved["parameters"])
    if saved["name"] not in PROBLEMS:
        check_once(problem)
    elif problem_name(problem) != saved["name"]:
        raise InputError(f"{path} belongs to the problem {saved['name']!r}, not to {problem_name(problem)!r}.")
    return problem


def _networks_of(path: Path, tensors: dict, metadata: dict, problem: Problem) -> Callable[[], Fields]:
    """What makes the networks that ``metadata`` describe, if they are modest beside the file."""
    model, names = metadata["model"], metadata["fields"]
    if len(names) > len(FIELDS) or not set(names) <= set(FIELDS) or len(set(names)) < len(names):
        known = ", ".join(FIELDS)
        raise InputError(f"{path} names the fields {names!r:.80}, but must name some of {known}, each once.")
    require_held(path, model, sum(t.numel() for t in tensors.values()))
    if model["name"] not in MODELS:
        raise InputError(f"{path} names the unknown model {model['name']!r}; known are {', '.join(MODELS)}.")
    network, options = MODELS[model["name"]], {k: v for k, v in model.items() if k != "name"}
    outputs = {CONTROL_DENSITY: problem.control_dim}  # the other fields are scalar
    states = lambda name: {"states": len(tensors[WORST])} if name == SUBSOLUTION else {}
    form = lambda name: dict(dim=problem.dim, outputs=outputs.get(name), **states(name), **options)
    return lambda: Fields({name: made(name, network, **form(name)) for name in names})


def _require_weights(path: Path, tensors: dict, dtype: object) -> None:
    """Raise `InputError` where weights are not finite numbers of the type ``dtype``."""
    if dtype not in ("float32", "float64"):
        raise InputError(f"{path} has dtype {dtype!r}, but must have float32 or float64.")
    if other := {str(t.dtype).removeprefix("torch.") for t in tensors.values()} - {dtype}:
        raise InputError(f"{path} holds weights of type {', '.join(sorted(other))}, but must hold {dtype} alone.")
    if not all(torch.isfinite(t).all() for t in tensors.values()):
        raise InputError(f"{path} holds weights that are not finite.")


def _section(saved: dict, config: dict) -> dict:
    """The problem of a run as its configuration has it, or its parameters where the configuration is of another problem."""
    section = current_section(config.get("problem"))
    target = str(section.get("_target_")) if isinstance(section, dict) else ""
    name = str(current_name(saved["name"], config.get("problem")))
    same = target.rpartition(".")[2].lower() == name.rpartition(".")[2]
    return section if same else saved["parameters"]


def _require_run(path: Path, certificate: object, config: object) -> None:
    """Raise `InputError` unless what `evaluate` reads of the run is made of groups of fields."""
    below = lambda group, name: group.get(name) or {} if isinstance(group, dict) else None
    effort = below(config, "certificate")
    if not all(isinstance(g, dict) for g in (certificate, effort, below(effort, "stage"), below(config, "trainer"))):
        raise InputError(f"{path} does not describe the run it came from.")
