"""A trained controller as a function of the state, and as a file, of which nothing is run and nothing is believed that it
does not hold."""

import copy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ocp_torch.control.described import described, problem_name, require_same
from ocp_torch.control.exported import about, coordinates_of, example_states, exported_function
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.pace import Pace
from ocp_torch.control.policies import BOUNDING, CLOSED, NETWORK, SADDLE, TRAJECTORIES, Policy, trained_policies
from ocp_torch.errors import InputError, notes, require_number
from ocp_torch.export import export
from ocp_torch.fields import CONTROL_DENSITY, LOG_OCCUPATION, MODELS, SUBSOLUTION, TRAJECTORY_VALUE, VALUE, Fields, made
from ocp_torch.files.limits import require_held, require_modest_problem
from ocp_torch.files.reading import FILE, FOLDER, kind
from ocp_torch.files.storage import load_tensors, save_tensors
from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.checks.check import check_once
from ocp_torch.problems.commands import ForeignProblem, current_name, current_section, made_by, naming
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.physical.system import System

# What a run calls the file of its controller, and its schema, raised when an older version could not read what is written.
FILE_NAME, SCHEMA = "controller.safetensors", 3
# What the file holds of a controller just as it is.
PLAIN = ("model", "occupation", "kind", "certificate", "config")
FIELDS = (VALUE, CONTROL_DENSITY, LOG_OCCUPATION, TRAJECTORY_VALUE, SUBSOLUTION)
# The states that come with a subsolution, as many as the file has.
WORST = f"networks.{SUBSOLUTION}.worst"
# Controls are given as what the states are.
States = TypeVar("States", Tensor, np.ndarray)


@dataclass(repr=False)
class Controller:
    """`u(x)` with all it came from.

    ``kind`` says which policy `u` is: ``value`` (from `V` alone), ``density`` (`w / mu`), ``minimised`` (`w / mu` with the
    `mu` of Lemma 2 in place of the trained one), ``trajectories`` (best for a whole step, from the `V` of the warm start) or
    ``subsolution`` (from `V` trained on for the lower bound).
    ``certificate`` is the dict of `certificate.json`, ``config`` the resolved configuration of the run, ``model`` the
    network's configuration. Controls are computed in double precision, whatever the networks were trained in: in single
    precision those of a pendulum were off by up to 1e-5 of the largest.
    """

    problem: Problem
    fields: Fields
    constants: Constants
    occupation: str | None
    kind: str
    model: dict
    certificate: dict
    config: dict

    def __post_init__(self) -> None:
        self._exact = copy.deepcopy(self.fields).double()
        how = self.occupation, self.problem, self._exact, self.constants
        self._policy = trained_policies(*how, every=True)[self.kind]

    def __repr__(self) -> str:
        said = self.certificate.get("gap")  # as the file has it, which may be anything
        gap = said.get("simulated") if isinstance(said, dict) else None
        sizes = f"d = {self.problem.dim}, m = {self.problem.control_dim}"
        known = f", gap {gap:.2%}" if isinstance(gap, float) else ""
        return f"Controller({problem_name(self.problem)}, {self.kind}, {sizes}{known})"

    def __call__(self, x: States) -> States:
        """Controls ``(N, m)`` at states ``(N, d)``: any reals, wrapped to the torus; NumPy in gives NumPy out, and floats of
        a precision give floats of it.

        Raises `InputError` for another shape."""
        return self._controls(self._policy, x)

    def _controls(self, policy: Policy, x: States) -> States:
        states = self._states("x", x)
        with torch.no_grad():
            u = policy(states.to(next(self._exact.parameters())).remainder(1.0)).to(states.dtype)
        return u.cpu().numpy() if isinstance(x, np.ndarray) else u

    @property
    def policy(self) -> Policy:
        """`u` at states of the unit cell, in float64 on the CPU, where certificates and metrics are computed."""
        fields = copy.deepcopy(self._exact).to("cpu")
        return trained_policies(self.occupation, self.problem, fields, self.constants, every=True)[self.kind]

    @property
    def held_for(self) -> float | None:
        """For how many units of time each control is meant to be held, and was in the simulations of the certificate; `None`
        for a controller that acts at every instant."""
        return self._policy.pace.step if isinstance(self._policy, HeldPolicy) else None

    def held(self, x: States, step: float) -> States:
        """Controls ``(N, m)`` at states ``(N, d)`` that are best where each is held for ``step`` units of time, from the `V`.

        Raises `InputError` as a call does, for a ``step`` that is no time, and where the controller holds no `V`."""
        others = {TRAJECTORIES: self._exact.trajectory_value, BOUNDING: self._exact.subsolution}
        field = others.get(self.kind, self._exact.value)
        if field is None:
            raise InputError("this controller holds no V, from which controls for a whole step follow.")
        pace = Pace.of(self.problem).with_step(require_number("step", step, above=0.0))
        return self._controls(HeldPolicy(self.problem, field, pace), x)

    def physical(self, s: States) -> States:
        """Controls ``(N, m)`` at states ``(N, d)``, both in the units of a `System`; beyond its box what they are at the
        nearest state of it. Raises `InputError` for another shape, and for a problem without physical units."""
        if not isinstance(self.problem, System):
            raise InputError(
                f"the problem {problem_name(self.problem)} has no physical units; give states of the torus to controller(x)."
            )
        states = self._states("s", s)
        exact = states.to(next(self._exact.parameters()))
        u = self.problem.from_controls(self(self.problem.to_torus(self.problem.chart.nearest(exact)))).to(states.dtype)
        return u.cpu().numpy() if isinstance(s, np.ndarray) else u

    def _states(self, name: str, given: States) -> Tensor:
        """``given`` as floats, if it is of shape ``(N, d)``."""
        states = torch.as_tensor(given)
        if states.ndim != 2 or states.shape[1] != self.problem.dim:
            raise InputError(f"{name} has shape {tuple(states.shape)}, but must have shape (N, {self.problem.dim}).")
        return states if states.is_floating_point() else states.double()

    def save(self, path: str | Path) -> None:
        """Write `controller.safetensors`: weights, and as JSON everything needed to build the controller again."""
        metadata = {
            "schema": SCHEMA,
            "problem": described(self.problem),
            "dtype": str(next(self.fields.parameters()).dtype).removeprefix("torch."),
            "fields": list(self.fields.networks),
            "bounds": asdict(self.constants),
            **{name: getattr(self, name) for name in PLAIN},
        }
        save_tensors(Path(path), dict(self.fields.state_dict()), metadata)

    def export(self, out: str | Path, format: str | None = None, coordinates: str | None = None) -> list[Path]:
        """Write it to ``out`` for where there is no PyTorch, and return the files: the control ``(m,)``, the value `V` and
        its gradient ``(d,)`` at a state ``(d,)``, with certificate, units and configuration inside, as JSON.

        ``format`` is `onnx` (a model of a batch of states, float32), `c` (a header and a C99 source, float or double) or
        `casadi` (a function of one state, float64); by default what the ending of ``out`` says. ``coordinates`` are `torus`
        or `physical`, by default physical where the problem is a `System`; beyond its box functions are what they are at the
        nearest state of it. Raises `InputError` for a wrong choice, a library that is missing, and a problem whose functions
        cannot be traced.
        """
        problem, place = self.problem, coordinates_of(self.problem, coordinates)
        function = exported_function(problem, self.fields, self.kind, self.occupation, self.constants, place)
        inside = {"coordinates": place, "problem": described(problem), "policy": self.kind, "held_for": self.held_for}
        inside |= {"certificate": self.certificate, "config": self.config}
        return export(function, example_states(problem, place), Path(out), format, about(problem, place), inside)


def controller_file(path: Path) -> Path:
    """The file of the controller that ``path`` names: itself, that of a run's folder, or of the newest run in a folder."""
    if kind(path) != FOLDER or kind(path / FILE_NAME) is not None:
        return path / FILE_NAME if kind(path) == FOLDER else path
    inside = [file for file in path.glob(f"*/{FILE_NAME}") if kind(file) == FILE]
    return max(inside, key=lambda file: file.stat().st_mtime, default=path / FILE_NAME)


def load_controller(path: str | Path, problem: Problem | None = None, device: str = "cpu") -> Controller:
    """Load a controller saved by a run, by its file, its run's folder, or a folder of runs, of which it is the newest; no
    code in the file is run.

    A controller of one of the package's problems rebuilds it from its parameters; one of a user's own problem needs that
    ``problem``, made with the same arguments. Raises `InputError` when the file is missing, damaged, of a newer schema, or
    does not fit the problem.
    """
    path = controller_file(Path(path))
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
        known = ", ".join(FIELDS)
        raise InputError(f"{path} names the fields {names!r:.80}, but must name some of {known}, each once.")
    require_held(path, model, sum(t.numel() for t in tensors.values()))
    if model["name"] not in MODELS:
        raise InputError(f"{path} names the unknown model {model['name']!r}; known are {', '.join(MODELS)}.")
    network, options = MODELS[model["name"]], {k: v for k, v in model.items() if k != "name"}
    outputs = {CONTROL_DENSITY: problem.control_dim}  # the other fields are scalar
    states = lambda name: {"states": len(tensors[WORST])} if name == SUBSOLUTION else {}
    form = lambda name: dict(dim=problem.dim, outputs=outputs.get(name), **states(name), **options)
    build = lambda: Fields({name: made(name, network, **form(name)) for name in names})
    with torch.device("meta"):
        # Shapes first, without memory: a crafted size must not be allocated before it is refused.
        shapes = {name: t.shape for name, t in build().state_dict().items()}
    if shapes != {name: t.shape for name, t in tensors.items()}:
        fit = f"its weights are not those of its model on a problem of dimension {problem.dim}"
        raise InputError(f"{path} does not fit: {fit}.")
    require_same(path, problem, saved)
    dtype = metadata["dtype"]
    if dtype not in ("float32", "float64"):
        raise InputError(f"{path} has dtype {dtype!r}, but must have float32 or float64.")
    if other := {str(t.dtype).removeprefix("torch.") for t in tensors.values()} - {dtype}:
        raise InputError(f"{path} holds weights of type {', '.join(sorted(other))}, but must hold {dtype} alone.")
    if not all(torch.isfinite(t).all() for t in tensors.values()):
        raise InputError(f"{path} holds weights that are not finite.")
    with torch.random.fork_rng(devices=[]):
        fields = build().to(dtype=getattr(torch, dtype))
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


def _require_run(path: Path, certificate: object, config: object) -> None:
    """What `evaluate` reads of the run is made of groups of fields."""
    below = lambda group, name: group.get(name) or {} if isinstance(group, dict) else None
    effort = below(config, "certificate")
    if not all(isinstance(g, dict) for g in (certificate, effort, below(effort, "stage"), below(config, "trainer"))):
        raise InputError(f"{path} does not describe the run it came from.")
