"""Requests from Python turned into those of the command line: the same names, the same configuration."""

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.version import VersionBase

from ocp_torch.cli.compose import configuration, run_data, with_own_defaults
from ocp_torch.control.described import plain_parameters, problem_name
from ocp_torch.errors import InputError, shown
from ocp_torch.files.plain import DEEPEST
from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.blame import named
from ocp_torch.problems.commands import LONGEST, PACKAGE, as_typed

# A problem, or the name of one, such as circle or my_module.MyProblem.
Asked = Problem | str
FIELD = re.compile(r"[A-Za-z_]\w*([./][A-Za-z_]\w*)*")
# Advice in error messages that makes no sense in Python.
ADDED = re.compile(r"; write \+\S+=\.\.\. to add an argument of your own")
# Hydra's global state.
APPLICATION = (GlobalHydra, HydraConfig, VersionBase)


def data_of(config_name: str, problem: Asked, parameters: Mapping[str, Any], settings: Mapping[str, Any]) -> dict:
    """The plain configuration ``config_name`` of ``problem``, an object or a name with ``parameters``, with ``settings`` by
    dotted names. Raises `InputError` as the command line does."""
    fields = flat(settings)
    given = isinstance(problem, Problem)
    if not given and not isinstance(problem, str):
        raise InputError(f"problem is {shown(problem)}, but must be a Problem or the name of one, as in 'circle'.")
    twice = [name for name in fields if given and name.split(".")[0] == "problem"]
    if given and (parameters or twice):
        name = next(iter(twice), None) or f"problem.{next(iter(parameters))}"
        raise InputError(f"{name} is set, but the problem is given as an object; make it with that argument.")
    if isinstance(problem, str):
        choice = "problem._target_" if "." in problem else "problem"
        own = {choice: problem, **{f"problem.{name}": value for name, value in parameters.items()}}
        fields = {**own, **fields}
    overrides = [f"{name}={as_typed(plain(name, value))}" for name, value in fields.items()]
    with own_hydra():
        overrides = with_own_defaults(config_name, overrides)
        try:
            data = configuration(config_name, overrides)[1]
        except InputError as error:
            raise InputError(
                ADDED.sub("; keywords that the call itself has not go to the problem", str(error))
            ) from None
        if isinstance(problem, Problem):
            data, overrides = {**data, "problem": section_of(problem)}, [*overrides, "problem=given"]
        return run_data(data, overrides)


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """``settings`` on one level, by dotted names. Raises `InputError` for a name that no field can have."""
    found: dict[str, Any] = {}
    if prefix.count(".") > DEEPEST:
        raise InputError(f"settings nests deeper than {DEEPEST} levels; one that holds itself has no end.")
    for name, value in settings.items():
        if not isinstance(name, str) or not FIELD.fullmatch(name):
            raise InputError(f"settings has {shown(name)}, but must have names of fields, as in 'trainer.batch'.")
        if name.split(".")[0].split("/")[0] == "hydra":
            raise InputError(f"{name} is for the command line alone; leave it out, and give folder=... for the folder.")
        inside = flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
        for key in inside.keys() & found.keys():
            raise InputError(f"{key} is set twice; leave one of them out.")
        found |= inside
    return found


def plain(name: str, value: Any, depth: int = 0) -> Any:
    """``value``, within ``depth`` lists, if it is made of numbers, words and lists of them, as plain data; `InputError` for
    anything else."""
    if isinstance(value, np.generic | np.ndarray | torch.Tensor):
        value = value.tolist()
    if depth > DEEPEST:
        raise InputError(f"{name} nests deeper than {DEEPEST} levels; a list that holds itself has no end.")
    if isinstance(value, list | tuple):
        return [plain(name, each, depth + 1) for each in value]
    value = str(value) if isinstance(value, Path) else value
    if isinstance(value, str) and (len(value) > LONGEST or not value.isprintable()):
        raise InputError(f"{name} is {shown(value)}, but must be a word of at most {LONGEST} printable signs.")
    if isinstance(value, bool | int | float | str | None):
        return value
    raise InputError(f"{name} is {shown(value)}, but must be a number, a word, None or a list of these.")


def section_of(problem: Problem) -> dict:
    """``problem`` as a section of a configuration: its class, and those of its arguments that a file can hold."""
    name = problem_name(problem)
    section: dict[str, Any] = {
        "_target_": f"{PACKAGE}.{type(problem).__name__}" if name in PROBLEMS else named(problem)
    }
    for key, value in plain_parameters(problem.parameters).items():
        with contextlib.suppress(InputError):  # other arguments must be given again to load a controller
            section[key] = plain(key, value)
    return section


@contextlib.contextmanager
def own_hydra() -> Iterator[None]:
    """Run the body with a fresh global state of Hydra, and restore the old one afterwards."""
    before = Singleton._instances
    Singleton._instances = {key: made for key, made in before.items() if key not in APPLICATION}
    try:
        yield
    finally:
        new = {key: made for key, made in Singleton._instances.items() if key not in APPLICATION}
        Singleton._instances = {**new, **before}
