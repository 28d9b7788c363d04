"""A saved controller, made again from its file, of which nothing is run and nothing is believed that it does not hold."""

from pathlib import Path

import torch

from ocp_torch.control.controller import PLAIN, SCHEMA, Controller, plain_parameters, problem_name
from ocp_torch.control.policies import CLOSED, NETWORK, SADDLE
from ocp_torch.errors import InputError, notes
from ocp_torch.fields import MODELS, Fields
from ocp_torch.fields.fields import CONTROL_DENSITY, LOG_OCCUPATION, VALUE
from ocp_torch.files.limits import require_held, require_modest_problem
from ocp_torch.files.storage import finite, load_tensors
from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.checks import check_once
from ocp_torch.problems.commands import ForeignProblem, made_by, naming
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.renamed import current_name, current_section

FIELDS = (VALUE, CONTROL_DENSITY, LOG_OCCUPATION)


def load_controller(path: str | Path, problem: Problem | None = None, device: str = "cpu") -> Controller:
    """Load a controller saved by a run; no code in the file is run.

    A controller of one of the package's problems rebuilds it from its parameters; one of a user's own problem needs that
    ``problem``, made with the same arguments. Raises `InputError` when the file is missing, damaged, of a newer schema, or
    does not fit the problem.
    """
    path = Path(path)
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
        problem = PROBLEMS[saved["name"]](**saved["parameters"])
    elif saved["name"] in PROBLEMS and problem_name(problem) != saved["name"]:
        raise InputError(f"{path} belongs to the problem {saved['name']!r}, not to {problem_name(problem)!r}.")
    else:
        check_once(problem)
    model, names = metadata["model"], metadata["fields"]
    if len(names) > len(FIELDS) or not set(names) <= set(FIELDS) or len(set(names)) < len(names):
        raise InputError(
            f"{path} names the fields {names!r:.80}, but must name some of {', '.join(FIELDS)}, each once."
        )
    require_held(path, model, sum(t.numel() for t in tensors.values()))
    if model["name"] not in MODELS:
        raise InputError(f"{path} names the unknown model {model['name']!r}; known are {', '.join(MODELS)}.")
    network, options = MODELS[model["name"]], {k: v for k, v in model.items() if k != "name"}
    outputs = {CONTROL_DENSITY: problem.control_dim}  # the other fields are scalar
    build = lambda: Fields({n: network(dim=problem.dim, outputs=outputs.get(n), **options) for n in names})
    with torch.device("meta"):
        # Shapes first, without memory: a crafted size must not be allocated before it is refused.
        shapes = {name: tuple(t.shape) for name, t in build().state_dict().items()}
    held = {name: tuple(t.shape) for name, t in tensors.items()}
    if shapes != held:
        raise InputError(
            f"{path} does not fit: its weights are not those of its model on a problem of dimension {problem.dim}."
        )
    _require_same_arguments(path, problem, saved["parameters"])
    if metadata["dtype"] not in ("float32", "float64"):
        raise InputError(f"{path} has dtype {metadata['dtype']!r}, but must have float32 or float64.")
    other = {str(t.dtype).removeprefix("torch.") for t in tensors.values()} - {metadata["dtype"]}
    if other:
        raise InputError(
            f"{path} holds weights of type {', '.join(sorted(other))}, but must hold {metadata['dtype']} alone."
        )
    if not all(torch.isfinite(t).all() for t in tensors.values()):
        raise InputError(f"{path} holds weights that are not finite.")
    with torch.random.fork_rng(devices=[]):
        fields = build().to(dtype=getattr(torch, metadata["dtype"]))
    fields.load_state_dict(tensors)
    fields = fields.to(device).requires_grad_(False)
    constants = Constants(**{**metadata["bounds"], "warnings": notes(metadata["bounds"]["warnings"])})
    return Controller(problem, fields, constants, **{name: metadata[name] for name in PLAIN})


def _section(saved: dict, config: dict) -> dict:
    """The problem of a run as its configuration names it, or as its parameters do where that is of something else."""
    section = current_section(config.get("problem"))
    target = str(section.get("_target_")) if isinstance(section, dict) else ""
    name = str(current_name(saved["name"], config.get("problem")))
    same = target.rpartition(".")[2].lower() == name.rpartition(".")[2]
    return section if same else saved["parameters"]


def _require_same_arguments(path: Path, problem: Problem, saved: dict) -> None:
    """Raise `InputError` where ``problem`` is not made as that of the run was."""
    given = finite(plain_parameters(problem.parameters))
    for name in given.keys() & saved.keys() - set(problem.incidental):
        if given[name] != saved[name]:
            raise InputError(
                f"problem.{name} is {given[name]!r}, but the run of {path} has {repr(saved[name])[:80]}; a controller is "
                "loaded with the problem it was trained for."
            )


def _require_run(path: Path, certificate: object, config: object) -> None:
    """What `evaluate` reads of the run is made of groups of fields."""
    below = lambda group, name: group.get(name) or {} if isinstance(group, dict) else None
    effort = below(config, "certificate")
    if not all(isinstance(g, dict) for g in (certificate, effort, below(effort, "stage"), below(config, "trainer"))):
        raise InputError(f"{path} does not describe the run it came from.")
