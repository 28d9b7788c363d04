"""Certify a controller somebody brings: load it, train a `V` to judge it by, and put both into a certificate."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn

from ocp_torch.bounds import Bounds, resolve_bounds
from ocp_torch.budgets import fill
from ocp_torch.calculus import Field
from ocp_torch.certificate import Certificate, CertificateSettings, Run, certify_policy, in_float64
from ocp_torch.certificate.black_box import BlackBox
from ocp_torch.config import build_certificate_settings, build_network
from ocp_torch.control_laws import ControlLaw, control_laws
from ocp_torch.controller import Controller, load_controller, problem_name
from ocp_torch.errors import InputError, nearest, require_integer
from ocp_torch.fields import Fields
from ocp_torch.fields.fields import VALUE
from ocp_torch.objectives import Dual
from ocp_torch.problems import Problem
from ocp_torch.samplers import UniformSampler, derive_seed
from ocp_torch.samples import Samples
from ocp_torch.steppers import Simultaneous, averaged, optimizer_maker, schedule_maker

# Branch of the seed tree for the V trained here, beside those of runs, evaluation and the stage.
JUDGE_STREAM = 4
MODEL = {"name": "mlp", "modes": None, "width": None, "depth": 3, "activation": None, "gated": None}


def certify(
    problem: Problem,
    controller: Callable | Controller,
    value: Field | Controller | None = None,
    settings: CertificateSettings | None = None,
    seed: int = 0,
    train_steps: int | None = None,
) -> Certificate:
    """What ``controller`` costs on ``problem``, and how far from optimal it can be.

    ``controller`` maps states ``(N, d)`` in the unit cell to controls ``(N, m)``: any function of tensors or arrays, or a
    `Controller` of ours. ``value`` is a `V` to judge it by, ``(N, d) -> (N,)`` and smooth, or a `Controller` that holds
    one; where it is `None` one is trained by the dual, for ``train_steps`` (default: by dimension; 0 for none, and then
    there is no lower bound). Raises `InputError` where the controller or the value fails.
    """
    require_integer("seed", seed, 0)
    defaults = fill({"model": dict(MODEL), "trainer": {}, "optimizer": {}, "certificate": {}}, problem)
    settings = settings or build_certificate_settings(defaults)
    bounds = resolve_bounds(problem)
    network = build_network(defaults["model"])
    law = law_of(controller, problem)
    steps = defaults["trainer"]["steps"] if train_steps is None else require_integer("train_steps", train_steps, 0)
    run = Run(problem_name(problem), "given", seed)
    if value is None and steps:
        batch, lr = defaults["trainer"]["batch"], defaults["optimizer"]["lr"]
        value = in_float64(train_value(problem, bounds, network, steps, batch, lr, seed)).value
        run = Run(problem_name(problem), "given", seed, steps, steps * batch)
    elif value is not None:
        value = value_of(value, problem)
    return certify_policy(problem, law, value, network, bounds, settings, run)


def train_value(
    problem: Problem,
    bounds: Bounds,
    network: Callable[..., nn.Module],
    steps: int,
    batch: int,
    lr: float,
    seed: int,
) -> Fields:
    """A `V` by the dual, with the defaults of a run."""
    fields = Fields.build(problem, (VALUE,), network, derive_seed(seed, JUDGE_STREAM, 0))
    objective = Dual(problem, bounds)
    sampler = UniformSampler(problem.dim, derive_seed(seed, JUDGE_STREAM, 1), torch.float32)
    draw = lambda: Samples.of(problem, sampler.draw(batch), divergences=False)
    makers = {player: optimizer_maker("soap", lr, betas=(0.95, 0.95)) for player in objective.players}
    stepper = Simultaneous(fields, objective, makers, schedule_maker("cosine", steps))
    average = averaged(fields, decay=0.98)
    for _ in range(steps):
        stepper.step(draw, lambda: average.update_parameters(fields))
    return average.module


def law_of(controller: Callable | Controller, problem: Problem) -> ControlLaw:
    """A law in float64: the networks of a `Controller` of ours, or a `BlackBox` around anything else."""
    if not isinstance(controller, Controller):
        return BlackBox(controller, problem)
    if (controller.problem.dim, controller.problem.control_dim) != (problem.dim, problem.control_dim):
        raise InputError(
            f"the controller is for d = {controller.problem.dim} and m = {controller.problem.control_dim}, "
            f"but the problem has d = {problem.dim} and m = {problem.control_dim}."
        )
    fields = in_float64(controller.fields)
    return control_laws(controller.occupation, controller.problem, fields, controller.bounds)[controller.kind]


def value_of(value: Field | Controller, problem: Problem) -> Field:
    """`V` in float64, tried on a few states."""
    if isinstance(value, Controller):
        if value.fields.value is None:
            raise InputError("value is a controller without V; give one trained by dual or pd.")
        value = in_float64(value.fields).value
    elif isinstance(value, nn.Module):
        value = in_float64(value)
    x = torch.full((2, problem.dim), 0.25, dtype=torch.float64)
    try:
        out = value(x)
    except Exception as error:  # whatever a stranger's code may raise
        raise InputError(f"value raised {type(error).__name__}: {error}.") from None
    if not isinstance(out, Tensor) or out.shape != (2,) or not bool(torch.isfinite(out).all()):
        shape = tuple(getattr(out, "shape", ()))
        raise InputError(f"value gave {shape} for states (2, {problem.dim}), but must give finite numbers (N,).")
    return value


def load_law(source: str, problem: Problem) -> Callable | Controller:
    """The controller the command line names: FILE.py:function, a run's folder or a file of ours, .onnx, or TorchScript."""
    path, _, name = str(source).rpartition(":")
    if path.endswith(".py"):
        return _function(Path(path), name)
    path = Path(str(source))
    if path.suffix == ".py":
        raise InputError(f"controller is {source!r}, but must name its function, as in {source}:function.")
    if not path.exists():
        raise InputError(
            f"controller is {str(source)!r}, which does not exist; give FILE.py:function, a run's folder, a "
            "controller.safetensors, an .onnx or a TorchScript file."
        )
    if path.is_dir() or path.suffix == ".safetensors":
        return load_saved(path, problem)
    return _onnx(path) if path.suffix == ".onnx" else _torchscript(path)


def load_saved(path: Path, problem: Problem) -> Controller:
    """A controller of ours, by its file or its run's folder; of the same problem, whatever its parameters were."""
    return load_controller(path / "controller.safetensors" if path.is_dir() else path, problem=problem)


def _function(path: Path, name: str) -> Callable:
    if not path.is_file():
        raise InputError(f"controller names {path}, which does not exist.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever a stranger's code may raise
        raise InputError(f"{path} cannot be run: {type(error).__name__}: {error}.") from None
    found = getattr(module, name, None)
    if not callable(found):
        known = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise InputError(f"{path} has no function {name!r}{nearest(name, known)}.")
    return found


def _onnx(path: Path) -> Callable:
    try:
        import onnxruntime
    except ImportError:
        raise InputError(f"{path} needs onnxruntime: pip install onnxruntime.") from None
    try:
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        (entry,) = session.get_inputs()
    except Exception as error:  # the runtime has no one type for a bad file
        raise InputError(f"{path} is not a model with one input that onnxruntime can run: {error}.") from None
    dtype = torch.float64 if "double" in entry.type else torch.float32
    return lambda x: torch.from_numpy(session.run(None, {entry.name: x.to(dtype).numpy()})[0])


def _torchscript(path: Path) -> Callable:
    try:
        return torch.jit.load(str(path), map_location="cpu").eval()
    except Exception as error:  # the loader has no one type for a bad file
        reason = next(iter(str(error).splitlines()), "")
        raise InputError(f"{path} is not a TorchScript file ({reason}).") from None
