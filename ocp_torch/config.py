"""From a resolved configuration, as plain nested data, to a trainer ready to run. No Hydra in here."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable

import torch
from torch import nn

from ocp_torch.bounds import resolve_bounds
from ocp_torch.budgets import fill
from ocp_torch.certificate import CertificateSettings, StageSettings
from ocp_torch.controller import problem_name
from ocp_torch.errors import InputError, nearest, require_choice, require_integer, require_number
from ocp_torch.fields import MODELS, Fields
from ocp_torch.objectives import METHODS
from ocp_torch.problems import Problem
from ocp_torch.samplers import SAMPLERS, derive_seed
from ocp_torch.steppers import STEPPERS, averaged, optimizer_maker, schedule_maker
from ocp_torch.training.settings import TrainerSettings
from ocp_torch.training.trainer import Trainer

# Branch of the seed tree for network weights, beside those of the samplers.
WEIGHTS_STREAM = 2
BOUND_FIELDS = ("occupation_bound", "value_bound", "control_bound")


def call(what, field: str, options: dict, **given):
    """``what(**given, **options)``; an option it does not take is an `InputError` that names ``field``."""
    taken = inspect.signature(what).parameters
    if not any(p.kind is p.VAR_KEYWORD for p in taken.values()):
        for name in options:
            if name not in taken:
                known = [n for n in taken if n not in given]
                raise InputError(
                    f"{field}.{name} is not a field of {field}{nearest(name, known)}; it takes {', '.join(known)}."
                )
        missing = [n for n, p in taken.items() if p.default is p.empty and n not in options and n not in given]
        if missing and inspect.isclass(what):
            raise InputError(f"{field}.{missing[0]} is missing; {what.__name__} needs it.")
    return what(**given, **options)


def build_problem(section: dict) -> Problem:
    """The problem ``_target_`` names, made with the other fields as arguments; any `Problem` subclass will do."""
    options = {k: v for k, v in section.items() if k != "_target_"}
    target = section.get("_target_")
    if not isinstance(target, str) or "." not in target:
        raise InputError(f"problem._target_ is {target!r}, but must be a class, as in my_module.MyProblem.")
    module_name, _, class_name = target.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise InputError(f"problem._target_ = {target} cannot be imported: {error}.") from None
    known = [n for n, c in vars(module).items() if inspect.isclass(c) and issubclass(c, Problem) and c is not Problem]
    if class_name not in known:
        raise InputError(
            f"problem._target_ = {target} is not a Problem subclass in that module{nearest(class_name, known)}."
        )
    return call(getattr(module, class_name), "problem", options)


def build_trainer(config: dict) -> Trainer:
    """Everything a run needs, in the order in which data flows. Raises `InputError` for any wrong field."""
    seed = require_integer("seed", config["seed"], 0)
    problem = build_problem(config["problem"])
    config = fill(config, problem)
    settings = call(TrainerSettings, "trainer", config["trainer"])
    torch.set_num_threads(settings.threads)
    method = dict(config["method"])
    name = require_choice("method.name", method.pop("name", None), METHODS)
    bounds = resolve_bounds(problem, **{field: method.pop(field, None) for field in BOUND_FIELDS})
    objective = call(METHODS[name], "method", method, problem=problem, bounds=bounds)
    network = build_network(config["model"])
    fields = Fields.build(problem, objective.fields, network, derive_seed(seed, WEIGHTS_STREAM))
    fields = fields.to(dtype=settings.torch_dtype, device=settings.torch_device)
    stepper = _build_stepper(config, fields, objective, settings.steps)
    average = call(averaged, "averaging", config["averaging"], fields=fields)
    sampler_name = require_choice("sampler.name", config["sampler"].get("name"), SAMPLERS)
    sampler = SAMPLERS[sampler_name](problem.dim, seed, settings.torch_dtype)
    names = (problem_name(problem), name)
    return Trainer(
        problem, fields, objective, bounds, stepper, average, sampler, settings, network, seed, names, config
    )


def build_network(model: dict) -> Callable[..., nn.Module]:
    """A maker of networks of the configured ``model``, given what a field needs of them."""
    network = MODELS[require_choice("model.name", model.get("name"), MODELS)]
    options = {k: v for k, v in model.items() if k != "name"}
    return lambda **form: call(network, "model", options, **form)


def build_certificate_settings(config: dict) -> CertificateSettings:
    """How much the final certificate may cost."""
    section = dict(config["certificate"])
    stage = call(StageSettings, "certificate.stage", section.pop("stage", None) or {})
    return call(CertificateSettings, "certificate", section, stage=stage)


def _build_stepper(config: dict, fields: Fields, objective, steps: int):
    options = dict(config["optimizer"])
    player_lr = options.pop("player_lr", None) or {}
    for player in player_lr:
        require_choice("optimizer.player_lr", player, objective.players)
    lr = options.pop("lr", None)
    makers = {p: call(optimizer_maker, "optimizer", options, lr=player_lr.get(p, lr)) for p in objective.players}
    schedule = call(schedule_maker, "schedule", config["schedule"], steps=steps)
    section = dict(config["stepper"])
    stepper = STEPPERS[require_choice("stepper.name", section.pop("name", None), STEPPERS)]
    for field in ("radius", "clip"):
        if section.get(field) is not None:
            require_number(f"stepper.{field}", section[field], above=0.0)
    return call(stepper, "stepper", section, fields=fields, objective=objective, optimizers=makers, schedule=schedule)
