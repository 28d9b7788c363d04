"""From a resolved configuration, as plain nested data, to a trainer ready to run. No Hydra in here."""

import ctypes
import importlib
import inspect
import platform
import re
from collections.abc import Callable
from typing import Any

import torch
from torch import nn

from ocp_torch.certificate import CertificateSettings, StageSettings
from ocp_torch.compute.processes import joined
from ocp_torch.control.described import problem_name
from ocp_torch.errors import InputError, call, nearest, require_choice, require_integer, require_number, require_section
from ocp_torch.fields import MODELS, TRAJECTORY_VALUE, VALUE, Fields
from ocp_torch.fields.fields import cost_unit
from ocp_torch.fields.waves import WAVE_STATES
from ocp_torch.files.limits import require_memory
from ocp_torch.maths.sampling import SAMPLERS, RowSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives import METHODS, Objective
from ocp_torch.problems import Dataset, Problem
from ocp_torch.problems.blame import in_their_words, origin, words
from ocp_torch.problems.checks.check import check_once, require_made
from ocp_torch.problems.commands import current_target
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.problems.problem import MOST_COORDINATES
from ocp_torch.steppers import STEPPERS, Stepper, averaged, optimizer_maker, schedule_maker
from ocp_torch.training.batches import Batches
from ocp_torch.training.budgets import fill
from ocp_torch.training.health import Health
from ocp_torch.training.settings import TrainerSettings
from ocp_torch.training.state import TrainState
from ocp_torch.training.trainer import Trainer
from ocp_torch.training.warm_start.iteration import ValueIteration
from ocp_torch.training.warm_start.settings import WarmStartSettings

# Numbers that a step keeps per unit of a network and state, at least: 6 to 10 were measured, in one and in four dimensions.
VALUES_PER_UNIT = 5
# Players of all methods; a learning rate may be set for each that the chosen method has.
PLAYERS = ("value", "density")
# Parameters of glibc's mallopt: M_MMAP_THRESHOLD and M_TRIM_THRESHOLD, at their largest values, and M_ARENA_MAX.
MALLOPT = ((-3, 2**25), (-1, 2**31 - 1), (-8, 1))
BOUND_FIELDS = ("occupation_bound", "value_bound", "control_bound")


def problem_class(target: object) -> type[Problem]:
    """The `Problem` subclass that ``target``, as in my_module.MyProblem, names."""
    if not isinstance(target, str) or not re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)+", target):
        raise InputError(f"problem._target_ is {target!r}, but must be a class, as in my_module.MyProblem.")
    module_name, _, class_name = current_target(target).rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # whatever a stranger's module may raise
        missing = isinstance(error, ImportError) and module_name.startswith(str(error.name))
        where = "" if missing else origin(error)
        raise InputError(f"problem._target_ = {target} cannot be imported: {words(error)}{where}.") from None
    known = [n for n, c in vars(module).items() if inspect.isclass(c) and issubclass(c, Problem) and c is not Problem]
    if class_name not in known:
        hint = nearest(class_name, known)
        if not hasattr(module, class_name):
            raise InputError(f"problem._target_ = {target}, but {module_name} has no class {class_name}{hint}.")
        raise InputError(f"problem._target_ = {target} is not a Problem subclass in that module{hint}.")
    return getattr(module, class_name)


def checked_problem(problem: Problem) -> Problem:
    """``problem``, if it is what `Problem` says one is and no larger than the memory; raises `InputError` otherwise."""
    require_made(problem)
    _require_room(problem.dim, problem.control_dim)
    check_once(problem)
    return problem


def build_problem(section: object) -> Problem:
    """The problem that ``_target_`` names, any `Problem` subclass, made with the other fields as arguments and checked."""
    options = require_section("problem", section)
    cls = problem_class(options.pop("_target_", None))
    dim = options.get("dim")
    if isinstance(dim, int) and 1 <= dim <= MOST_COORDINATES:  # before a large problem is made, which may take long
        _require_room(dim, options.get("control_dim"))
    return checked_problem(in_their_words(lambda: call(cls, "problem", options), cls.__name__, cls))


def _require_room(dim: int, control_dim: object) -> None:
    """Raise `InputError` where `B`, at all states at which the embedding looks for waves, would not fit into the memory."""
    given = control_dim if isinstance(control_dim, int) and 1 <= control_dim <= MOST_COORDINATES else dim
    require_memory("the number of entries of B, problem.dim times control_dim,", dim * given, 8.0 * WAVE_STATES)


def use_threads(threads: int) -> None:
    """Use ``threads`` CPU threads, and with glibc keep freed memory for the next tensor of any thread.

    By default large blocks return to the system at once, and the page faults of getting them back can cost as much as the
    arithmetic: two threads took 1.4 times as long as one for the work of one."""
    torch.set_num_threads(threads)
    if platform.libc_ver()[0] == "glibc":
        for parameter, value in MALLOPT:
            ctypes.CDLL(None).mallopt(parameter, value)


def _chosen(group: str, section: object, table: dict) -> tuple[str, dict]:
    """The name in ``table`` that the configuration of a ``group`` chooses, and the group's other fields."""
    fields = require_section(group, section)
    return require_choice(f"{group}.name", fields.pop("name", None), table), fields


def build_trainer(config: dict, problem: Problem | None = None) -> Trainer:
    """The trainer of ``config``, with all its parts; ``problem`` is the problem, where it has been made already. Raises
    `InputError` for any wrong field."""
    seed = require_integer("seed", config["seed"], 0)
    problem = build_problem(config["problem"]) if problem is None else checked_problem(problem)
    config = fill(config, problem)
    settings = call(TrainerSettings, "trainer", require_section("trainer", config["trainer"]))
    use_threads(settings.threads)
    name, method = _chosen("method", config["method"], METHODS)
    constants = resolve_constants(problem, **{field: method.pop(field, None) for field in BOUND_FIELDS})
    objective = call(METHODS[name], "method", method, problem=problem)
    if settings.target_gap is not None and VALUE not in objective.fields:
        raise InputError(
            f"trainer.target_gap is {settings.target_gap:g}, but {name} gives no lower bound to measure a gap by; "
            "use dual or pd."
        )
    ranks = joined()
    ranks.require_shares("trainer.batch", settings.batch)
    if method.get("density_batch") is not None:
        ranks.require_shares("method.density_batch", method["density_batch"])
    network = build_network(config["model"])
    warm_start = _warm_start(config, problem, objective, constants)
    # The last field, so that the initial weights of the others do not depend on it.
    names = (*objective.fields, *([] if warm_start is None else [TRAJECTORY_VALUE]))
    fields = Fields.build(problem, names, network, derive_seed(seed, Branch.WEIGHTS))
    fields = fields.to(dtype=settings.torch_dtype, device=settings.torch_device)
    if warm_start is not None:
        fields.trajectory_value.requires_grad_(False)
    # Numbers that a step keeps for a state, at least: x, f, a, mu0 (a constant B takes no room), units and derivatives.
    kept = 2 * problem.dim + 2 + VALUES_PER_UNIT * sum(p.shape[0] for p in fields.parameters() if p.dim() == 2)
    require_memory("trainer.batch", settings.batch, settings.torch_dtype.itemsize * kept)
    stepper = _build_stepper(config, fields, objective, settings.steps, cost_unit(problem))
    average = call(averaged, "averaging", require_section("averaging", config["averaging"]), fields=fields)
    sampler, visited = _sampler(config, problem, settings, seed)
    batches = Batches(problem, fields, objective, sampler, settings.batch, seed, visited)
    warm = None if warm_start is None else ValueIteration(problem, fields.trajectory_value, warm_start, seed)
    run = (problem_name(problem), name)
    state = TrainState(run, config, fields, average, stepper, batches, Health.of(problem), constants, warm=warm)
    return Trainer(problem, objective, settings, network, seed, state, ranks=ranks)


def _sampler(config: dict, problem: Problem, settings: TrainerSettings, seed: int) -> tuple[Any, Any]:
    """The sampler of training states, and `sampler.visited`; a data set has states of its own."""
    name, section = _chosen("sampler", config["sampler"], SAMPLERS)
    visited = section.pop("visited", None)
    if problem.has_simulator:
        given = {"dim": problem.dim, "seed": seed, "dtype": settings.torch_dtype}
        return call(SAMPLERS[name], "sampler", section, **given), visited
    if name == "importance":
        raise InputError(
            "sampler.name is importance, but a data set has no data where it was not recorded; leave it out."
        )
    if settings.target_gap is not None:
        raise InputError("trainer.target_gap is set, but a data set has no simulation to see a gap by.")
    assert isinstance(problem, Dataset)
    return RowSampler(problem.rows, seed, problem.recording.digest), visited


def _warm_start(config: dict, problem: Problem, objective: Objective, constants: Constants) -> WarmStartSettings | None:
    """The settings of the warm start, or `None` for none, as in older runs, whose configuration has no section for it."""
    if config.get("warm_start") is None:
        return None
    settings = call(WarmStartSettings, "warm_start", require_section("warm_start", config["warm_start"]))
    return settings if settings.wanted(problem, objective, constants) else None


def build_network(model: object) -> Callable[..., nn.Module]:
    """A function that makes networks of the configured ``model``, given the form a field wants."""
    name, options = _chosen("model", model, MODELS)
    return lambda **form: call(MODELS[name], "model", options, **form)


def build_certificate_settings(config: dict) -> CertificateSettings:
    """The settings of the final certificate."""
    section = require_section("certificate", config["certificate"])
    stage_section = require_section("certificate.stage", section.pop("stage", {}))
    stage = call(StageSettings, "certificate.stage", stage_section)
    return call(CertificateSettings, "certificate", section, stage=stage)


def _build_stepper(config: dict, fields: Fields, objective: Objective, steps: int, unit: float) -> Stepper:
    options = require_section("optimizer", config["optimizer"])
    player_lr = require_section("optimizer.player_lr", options.pop("player_lr", {}))
    for player, rate in player_lr.items():
        require_choice("optimizer.player_lr", player, PLAYERS)
        if rate is not None:
            require_choice("optimizer.player_lr", player, objective.players)
    lr = options.pop("lr", None)
    rates = {player: lr if player_lr.get(player) is None else player_lr[player] for player in objective.players}
    makers = {player: call(optimizer_maker, "optimizer", options, lr=rate) for player, rate in rates.items()}
    schedule = call(schedule_maker, "schedule", require_section("schedule", config["schedule"]), steps=steps)
    name, section = _chosen("stepper", config["stepper"], STEPPERS)
    for field in ("radius", "clip"):
        if section.get(field) is not None:
            require_number(f"stepper.{field}", section[field], above=0.0)
    given = dict(fields=fields, objective=objective, optimizers=makers, schedule=schedule, unit=unit)
    return call(STEPPERS[name], "stepper", section, **given)
