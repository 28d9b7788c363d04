"""A sweep is refused before its first job where a job of it could never run."""

from collections.abc import Callable
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from ocp_torch.cli.compose import configuration, parsed, run_data
from ocp_torch.cli.explain import explain, is_choice
from ocp_torch.errors import InputError, require_flag, require_section, shown

MOST_TRIED = 8  # jobs of a sweep that are tried for one value


def check_sweep(config_name: str, overrides: list[str], check: Callable[[dict], object]) -> None:
    """Raise `InputError` where a job of the sweep would not even compose, every value of every field, one at a time; or
    where ``check`` lets none through that has a value of some kind: words are, and numbers by their sign. What the problem
    makes of numbers, a sweep may be there to find out."""
    try:
        options = BasicSweeper.split_arguments(parsed(overrides), None)[0]
    except HydraException as error:
        raise InputError(explain(error, config_name)) from None
    is_hydras = lambda override: override.startswith(("hydra.", "hydra/"))
    defaults: dict[tuple, dict] = {}
    for one in dict.fromkeys(o for job in options for o in job):
        first = [o for o in next(job for job in options if one in job) if not is_hydras(o)]
        chosen = [o for o in first if is_choice(o) or o.lstrip("+").startswith("problem._target_=")]
        if (key := tuple(chosen)) not in defaults:
            defaults[key] = configuration(config_name, chosen, whole=False)[1]
        require_kinds(configuration(config_name, first)[1], defaults[key])
    ours = [[o for o in job if not is_hydras(o)] for job in options]
    for one in representatives(parsed(overrides)):
        jobs = [job for job in ours if one in job][:MOST_TRIED]
        refusals: list[InputError] = []
        for job in jobs:
            try:
                check(run_data(configuration(config_name, job)[1], job))
                break
            except InputError as error:
                refusals.append(error)
        if jobs and len(refusals) == len(jobs):
            raise refusals[0]
    # Hydra's own settings are the same for every job.
    configuration(config_name, [o for o in options[0] if is_hydras(o)], whole=False)


def representatives(overrides: list[Override]) -> list[str]:
    """One override for each kind of value that is swept over: each word, and numbers of each type and sign. Fields of the
    problem and `resume` are left to the jobs."""
    found: dict[tuple, str] = {}
    for override in overrides:
        name = override.key_or_group
        if not override.is_sweep_override() or name.startswith(("hydra", "problem.", "resume")) or is_choice(name):
            continue
        for one in BasicSweeper.split_arguments([override], None)[0]:
            value: Any = parsed(one)[0].value()
            number = isinstance(value, int | float) and not isinstance(value, bool)
            found.setdefault((name, type(value), value > 0 if number else str(value)), one[0])
    return list(found.values())


def require_kinds(data: Any, default: Any, name: str = "") -> None:
    """Raise `InputError` where a number, a flag or a group of fields of ``default`` is something else in ``data``."""
    if isinstance(default, dict):
        for key in default.keys() & require_section(name, data).keys():
            require_kinds(data[key], default[key], f"{name}.{key}".lstrip("."))
    elif isinstance(default, bool):
        require_flag(name, data)
    elif isinstance(default, int | float) and not (isinstance(data, int | float) and not isinstance(data, bool)):
        raise InputError(f"{name} is {shown(data)}, but must be a number.")
