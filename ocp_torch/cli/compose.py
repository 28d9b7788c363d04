"""From a command line to a configuration, with Hydra; errors of Hydra become one sentence."""

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

from ocp_torch.cli.explain import CHECKOUT, CONFIGS, INSTALLED, explain, is_choice
from ocp_torch.errors import InputError, nearest, shown
from ocp_torch.runs.configuration import next_subfolder
from ocp_torch.runs.resume import find_run, resumed_configuration

# The override that chooses no problem: fields of one would be mixed with those of a user's own class.
NO_CHOICE = "~problem"


def place(part: str) -> Path:
    """The folder ``part`` of the checkout, wherever a run starts, or without a checkout of the current folder."""
    return (Path.cwd() if INSTALLED else CHECKOUT) / part


def register_resolvers() -> None:
    """Register `${checkout:outputs}`, the `place` of outputs; `${problem_name:a.b.Circle}`, circle; `${start_folder:dir}`,
    the subfolder of a run's folder for the configuration of this start."""
    resolvers = {
        "checkout": lambda part: str(place(part)),
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
    except ValueError:  # such as a number of more digits than Python reads
        raise InputError("the command line holds a number of thousands of digits, which nothing here takes.") from None


def with_own_defaults(config_name: str, overrides: list[str]) -> list[str]:
    """``overrides`` changed so that a class named by ``problem._target_`` starts from its own defaults: fields of the problem
    group, which belong to another problem, are left out, and `problem.x=` sets or adds x."""
    bare = [o.lstrip("+") for o in overrides]
    if not any(o.startswith("problem._target_=") for o in bare):
        return overrides
    found: list[str] = []
    grouped = any(group == "problem" and choice for group, choice in _file(config_name)[0])
    for given, field in zip(overrides, bare, strict=True):
        if grouped and (field.startswith("problem=") or given == NO_CHOICE):
            continue
        if grouped and field.startswith("problem._target_="):
            found.append(NO_CHOICE)  # here, as Hydra wants all overrides in one piece
        found.append(f"++{field}" if field.startswith("problem.") else given)
    return found


@cache
def _file(config_name: str) -> tuple[list[tuple[str, Any]], list[str]]:
    """The groups of a configuration file with their choices, and its top-level fields."""
    file: Any = OmegaConf.to_container(OmegaConf.load(CONFIGS / f"{config_name}.yaml"), resolve=False)
    chosen = [item for entry in file.pop("defaults", []) if isinstance(entry, dict) for item in entry.items()]
    return chosen, list(file)


def composed(config_name: str, overrides: list[str], roots: tuple[Path, ...] = ()) -> dict:
    """The data for a command of the configuration ``config_name``: `configuration`, then `run_data` with its ``roots``."""
    overrides = with_own_defaults(config_name, overrides)
    return run_data(configuration(config_name, overrides)[1], overrides, roots)


def configuration(config_name: str, overrides: list[str], whole: bool = True) -> tuple[DictConfig, dict]:
    """The composed configuration with Hydra's own part, and without that part as plain data (see `resolved`).

    Raises `InputError` where it cannot be composed, or a group or field of ``config_name`` is left out, or another is added.
    """
    own = any(o.key_or_group == "problem._target_" and not o.is_delete() for o in parsed(overrides))
    for override in parsed(overrides):
        name = override.key_or_group
        # All groups are needed, as defaults are in the configuration alone; only a user's own class needs no problem group.
        needed = not name.startswith(("hydra", "problem.", "experiment")) and not (own and name == "problem")
        if override.is_delete() and needed:
            raise InputError(f"~{name} leaves out {name}, which is needed; set it to another value instead.")
        # Of a list Hydra mixes the files, and the last one wins: that is of use for experiments alone.
        value = override.value()
        if isinstance(value, list) and len(value) > 1 and is_choice(name) and name != "experiment":
            several = ",".join(map(str, value))
            raise InputError(f"{name} is {shown(value)}, but must be one name; -m {name}={several} takes each in turn.")
    try:
        with initialize_config_dir(str(CONFIGS), job_name=config_name, version_base="1.3"):
            config = compose(config_name, overrides, return_hydra_config=True)
        data = resolved(config, whole)
    except InputError:
        raise
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(explain(error, config_name, overrides)) from None
    except (
        ValueError,
        TypeError,
    ) as error:  # for some mistakes Hydra raises builtin exceptions, and does not say where they are
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(f"{' '.join(overrides)} cannot be composed: {reason}.") from None
    finally:
        GlobalHydra.instance().clear()
    chosen, fields = _file(config_name)
    groups = {(key.partition("@")[2] or key).split(".")[0]: choice for key, choice in chosen}
    for name in (*(group for group, choice in groups.items() if choice is not None), *fields):
        if name not in data and not name.startswith(("hydra", "override ")):
            raise InputError(f"{name} is missing; give {name}=... on the command line.")
    for name in data:
        if name not in groups and name not in fields:
            known = [own for own in (*groups, *fields) if not own.startswith(("hydra", "override "))]
            hint = nearest(str(name), known)
            raise InputError(f"{name} is not a field of the configuration{hint}; it has {', '.join(known)}.")
    return config, data


def resolved(config: DictConfig, whole: bool = True) -> dict:
    """``config`` without Hydra's part, resolved to plain data; OmegaConf raises where it cannot be, or for missing values if
    it must be ``whole``."""
    own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    data: Any = OmegaConf.to_container(own, resolve=True, throw_on_missing=whole)
    return data


def run_data(data: dict, overrides: list[str], roots: tuple[Path, ...] = ()) -> dict:
    """The configuration a run is built from: ``data``, or that of the run which ``resume`` names (`auto`: the last one with
    this configuration below ``roots`` and `outputs/`)."""
    named = [o.key_or_group for o in parsed(overrides) if not o.key_or_group.startswith("hydra")]
    if "problem._target_" in named:
        named.remove("problem") if "problem" in named else None
        # Fields that an experiment sets belong to another problem as well.
        mine = {name.split(".")[1] for name in named if name.startswith("problem.")}
        data = {**data, "problem": {k: v for k, v in data["problem"].items() if k in mine}}
    if data.get("resume") == "":
        raise InputError("resume is empty, but must be a run's folder, a checkpoint, auto or null.")
    if data.get("resume") == "auto":
        run = find_run(data, (*roots, place("outputs")))
        data = {**data, "resume": str(run) if run else None}
    return data if data.get("resume") is None else resumed_configuration(data, named)
