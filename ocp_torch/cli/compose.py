"""From a command line to a configuration, with Hydra; whatever Hydra has against it becomes one sentence."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ocp_torch.cli.explain import CHECKOUT, CONFIGS, explain
from ocp_torch.cli.required import require_places, require_sections
from ocp_torch.errors import InputError
from ocp_torch.runs.configuration import next_subfolder
from ocp_torch.runs.resume import find_run, resumed_configuration

OUTPUTS = CHECKOUT / "outputs"
# No choice of a problem, whose fields would be mixed with those of a user's own class.
NO_CHOICE = "~problem"


def register_resolvers() -> None:
    """`${checkout:outputs}`: a folder of the checkout wherever a run starts; `${problem_name:a.b.Circle}`: circle;
    `${start_folder:dir}`: where in a run's folder this start's configuration goes."""
    resolvers = {
        "checkout": lambda part: str(CHECKOUT / part),
        "problem_name": lambda target: str(target).rpartition(".")[2].lower(),
        "start_folder": lambda folder: next_subfolder(Path(folder)),
    }
    for name, resolver in resolvers.items():
        OmegaConf.register_new_resolver(name, resolver, replace=True)


def parsed(overrides: list[str]) -> list[Override]:
    """The overrides as Hydra reads them; `InputError` where it cannot."""
    try:
        return OverridesParser.create().parse_overrides(overrides)
    except HydraException as error:
        raise InputError(explain(error, "train")) from None
    except ValueError:  # a number of more digits than Python reads
        raise InputError("the command line holds a number of thousands of digits, which nothing here takes.") from None


def with_own_defaults(config_name: str, overrides: list[str]) -> list[str]:
    """``overrides`` in which a class that ``problem._target_`` names starts from its own defaults: the group's fields,
    which are another problem's, are left out, and `problem.x=` sets or adds x, whether it was there or not."""
    bare = [o.lstrip("+") for o in overrides]
    if not any(o.startswith("problem._target_=") for o in bare):
        return overrides
    found: list[str] = []
    grouped = _has_problem_group(config_name)
    for given, field in zip(overrides, bare, strict=True):
        if grouped and (field.startswith("problem=") or given == NO_CHOICE):
            continue
        if grouped and field.startswith("problem._target_="):
            found.append(NO_CHOICE)  # beside the other overrides, which Hydra wants in one piece
        found.append(f"++{field}" if field.startswith("problem.") else given)
    return found


@cache
def _has_problem_group(config_name: str) -> bool:
    file: Any = OmegaConf.to_container(OmegaConf.load(CONFIGS / f"{config_name}.yaml"))
    return any(isinstance(choice, dict) and choice.get("problem") for choice in file.get("defaults", []))


def composed(config_name: str, overrides: list[str], roots: tuple[Path, ...] = ()) -> dict:
    """What a command of the configuration ``config_name`` is given, as plain data. `roots`: see `run_data`.

    Raises `InputError`, in one sentence, for whatever Hydra or OmegaConf has against it.
    """
    overrides = with_own_defaults(config_name, overrides)
    return run_data(plain(configuration(config_name, overrides), config_name, overrides), overrides, roots)


def configuration(config_name: str, overrides: list[str]) -> DictConfig:
    """The composed configuration with Hydra's own part, `hydra`. Raises `InputError`."""
    require_places(parsed(overrides))
    try:
        with initialize_config_dir(str(CONFIGS), job_name=config_name, version_base="1.3"):
            return compose(config_name, overrides, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException, ValueError, TypeError) as error:
        raise _told(error, config_name, overrides) from None
    finally:
        GlobalHydra.instance().clear()


def plain(config: DictConfig, config_name: str, overrides: list[str], whole: bool = True) -> dict:
    """``config`` as nested plain data without Hydra's own part, interpolations resolved. Raises `InputError` where a group or
    field of ``config_name`` has no place in it, or, if it has to be ``whole``, no value."""
    try:
        data = resolved(config, whole)
    except (OmegaConfBaseException, ValueError, TypeError) as error:
        raise _told(error, config_name, overrides) from None
    return require_sections(data, config_name)


def resolved(config: DictConfig, whole: bool = True) -> dict:
    """``config`` as plain data without Hydra's own part; OmegaConf raises where it cannot be resolved or is not ``whole``."""
    own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    data: Any = OmegaConf.to_container(own, resolve=True, throw_on_missing=whole)
    return data


def _told(error: Exception, config_name: str, overrides: list[str]) -> InputError:
    if isinstance(error, InputError):
        return error
    if isinstance(error, HydraException | OmegaConfBaseException):
        return InputError(explain(error, config_name, overrides))
    # Hydra has no exception of its own for some slips, and does not say where they are.
    return InputError(f"{' '.join(overrides)} cannot be composed: {' '.join(str(error).split()).rstrip('.')}.")


def run_data(data: dict, overrides: list[str], roots: tuple[Path, ...] = ()) -> dict:
    """``data`` as a run is built from it: that of the run to go on with, where ``resume`` names one (`auto`: the last of
    this configuration below ``roots`` and `outputs/`)."""
    named = [o.key_or_group for o in parsed(overrides) if not o.key_or_group.startswith("hydra")]
    if "problem._target_" in named:
        named.remove("problem") if "problem" in named else None
        # What an experiment sets is another problem's as well.
        mine = {name.split(".")[1] for name in named if name.startswith("problem.")}
        data = {**data, "problem": {k: v for k, v in data["problem"].items() if k in mine}}
    if data.get("resume") == "auto":
        run = find_run(data, (*roots, OUTPUTS))
        data = {**data, "resume": str(run) if run else None}
    if data.get("resume") is not None:
        data = resumed_configuration(data, named)
    return data
