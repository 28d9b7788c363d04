"""From a command line to plain data, with Hydra; whatever Hydra has against it becomes one sentence."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ocp_torch.errors import InputError, nearest, require_flag, require_section, shown
from ocp_torch.runs.resume import find_run, next_subfolder, resumed_configuration

CHECKOUT = Path(__file__).resolve().parents[2]
CONFIGS = CHECKOUT / "configs"
OUTPUTS = CHECKOUT / "outputs"
MOST_TRIED = 8  # jobs of a sweep that are tried for one value
# No choice of a problem, whose fields would be mixed with those of a user's own class.
NO_CHOICE = "~problem"
EXTRAS = {"hydra/launcher": "parallel"}  # Hydra's plugin groups -> the extra that installs them


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


def plain(config: DictConfig, whole: bool = True) -> dict:
    """The configuration as nested plain data, interpolations resolved; nothing is missing if it has to be ``whole``."""
    data = OmegaConf.to_container(config, resolve=True, throw_on_missing=whole)
    data.pop("hydra", None)
    return data


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
    defaults = OmegaConf.to_container(OmegaConf.load(CONFIGS / f"{config_name}.yaml")).get("defaults", [])
    return any(isinstance(choice, dict) and choice.get("problem") for choice in defaults)


def prepared(data: dict, overrides: list[str], roots: tuple[Path, ...] = ()) -> dict:
    """``data`` as a run is built from it: that of the run to go on with, where ``resume`` names one (`auto`: the last of
    this configuration below ``roots``)."""
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


def composed(config_name: str, overrides: list[str], roots: tuple[Path, ...] = ()) -> dict:
    """What the job will be given; whatever Hydra or OmegaConf has against it becomes an `InputError` of one sentence."""
    overrides = with_own_defaults(config_name, overrides)
    require_places(overrides)
    return prepared(_composed(config_name, overrides), overrides, roots)


def _composed(config_name: str, overrides: list[str], whole: bool = True) -> dict:
    """The composed configuration as plain data; where not the ``whole`` is wanted, what is still missing stays `???`."""
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            data = plain(compose(config_name, overrides), whole)
            return require_sections(data, config_name)
    except (HydraException, OmegaConfBaseException, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        known = isinstance(error, HydraException | OmegaConfBaseException)
        # Hydra has no exception of its own for some slips, and does not say where they are.
        reason = " ".join(str(error).split()).rstrip(".")
        sentence = (
            explain(error, config_name, overrides) if known else f"{' '.join(overrides)} cannot be composed: {reason}."
        )
        raise InputError(sentence) from None
    finally:
        GlobalHydra.instance().clear()


def require_places(overrides: list[str]) -> None:
    """Raise `InputError` where a field or a group of ours is left out: defaults stand in the configuration alone. A class of
    a user's own may do without some of the problem's, or all."""
    own = any(o.lstrip("+").startswith("problem._target_=") for o in overrides)
    for override in parsed(overrides):
        name = override.key_or_group
        if own and name == "problem":
            continue
        if override.is_delete() and not name.startswith(("hydra", "problem.", "experiment")):
            raise InputError(f"~{name} leaves out {name}, which is needed; set it to another value instead.")


def require_sections(data: dict, config_name: str) -> dict:
    """``data``, if each group and field at the top of the configuration has a place in it; else `InputError`."""
    file = OmegaConf.to_container(OmegaConf.load(CONFIGS / f"{config_name}.yaml"), resolve=False)
    chosen = [item for entry in file.pop("defaults", []) if isinstance(entry, dict) for item in entry.items()]
    groups = [(key.partition("@")[2] or key).split(".")[0] for key, choice in chosen if choice is not None]
    for name in dict.fromkeys([*groups, *file]):
        if name not in data and not name.startswith(("hydra", "override ")):
            raise InputError(f"{name} is missing; give {name}=... on the command line.")
    return data


def check_sweep(config_name: str, overrides: list[str], check: Callable[[dict], object]) -> None:
    """Raise `InputError` where a job of the sweep would not even compose, every value of every field, one at a time; or
    where ``check`` lets none through that has a value of some kind: words are, and numbers by their sign. What the problem
    makes of numbers, a sweep may be there to find out."""
    require_places(overrides)
    try:
        options = BasicSweeper.split_arguments(parsed(overrides), None)[0]
    except HydraException as error:
        raise InputError(explain(error, config_name)) from None
    defaults: dict[tuple, dict] = {}
    for one in dict.fromkeys(o for job in options for o in job):
        first = [o for o in next(job for job in options if one in job) if not o.startswith(("hydra.", "hydra/"))]
        chosen = [o for o in first if is_choice(o) or o.lstrip("+").startswith("problem._target_=")]
        if (key := tuple(chosen)) not in defaults:
            defaults[key] = _composed(config_name, chosen, whole=False)
        require_kinds(_composed(config_name, first), defaults[key])
    ours = [[o for o in job if not o.startswith(("hydra.", "hydra/"))] for job in options]
    for one in representatives(parsed(overrides)):
        jobs = [job for job in ours if one in job][:MOST_TRIED]
        require_one([partial(_checked_job, check, config_name, job) for job in jobs])
    # Hydra's own settings are the same for every job.
    _composed(config_name, [o for o in options[0] if o.startswith(("hydra.", "hydra/"))])


def _checked_job(check: Callable[[dict], object], config_name: str, overrides: list[str]) -> None:
    check(prepared(_composed(config_name, overrides), overrides))


def require_one(tries: list[Callable[[], None]]) -> None:
    """Raise the `InputError` of the first of ``tries`` if all of them raise one."""
    first: InputError | None = None
    for attempt in tries:
        try:
            return attempt()
        except InputError as error:
            first = first or error
    if first is not None:
        raise first


def representatives(overrides: list[Override]) -> list[str]:
    """One override for each kind of value that is swept over: each word, and numbers of each type and sign. Fields of the
    problem and `resume` are left to the jobs."""
    found: dict[tuple, str] = {}
    for override in overrides:
        name = override.key_or_group
        if not override.is_sweep_override() or name.startswith(("hydra", "problem.", "resume")) or is_choice(name):
            continue
        for one in BasicSweeper.split_arguments([override], None)[0]:
            value = parsed(one)[0].value()
            number = isinstance(value, int | float) and not isinstance(value, bool)
            found.setdefault((name, type(value), value > 0 if number else str(value)), one[0])
    return list(found.values())


def is_choice(override: str) -> bool:
    """Whether it chooses a file of a group, and sets no field."""
    return (CONFIGS / override.lstrip("+~").split("=")[0].partition("@")[0]).is_dir()


def require_kinds(data: object, default: object, name: str = "") -> None:
    """Raise `InputError` where a number, a flag or a group of fields of ``default`` is something else in ``data``."""
    if isinstance(default, dict):
        for key in default.keys() & require_section(name, data).keys():
            require_kinds(data[key], default[key], f"{name}.{key}".lstrip("."))
    elif isinstance(default, bool):
        require_flag(name, data)
    elif isinstance(default, int | float) and not (isinstance(data, int | float) and not isinstance(data, bool)):
        raise InputError(f"{name} is {shown(data)}, but must be a number.")


def explain(error: Exception, config_name: str, overrides: Iterable[str] = ()) -> str:
    """Hydra's and OmegaConf's own words as one sentence; ``overrides`` name the groups that were chosen."""
    text = str(error)
    unknown = re.search(r"Could not find '([\w./-]+)/([^'/]*)'", text)
    if isinstance(error, MissingConfigException) and unknown:
        group, choice = unknown.groups()
        if group in EXTRAS:
            return (
                f"{group} is {choice!r}, which is not installed; pip install -e '.[{EXTRAS[group]}]' brings joblib's."
            )
        known = sorted(p.stem for p in (CONFIGS / group).glob("*.yaml"))
        return f"{group} is {choice!r}, but must be one of {', '.join(known)}{nearest(choice, known)}."
    override = re.search(r"Could not override '([\w.@/-]+)'", text)
    if isinstance(error, ConfigCompositionException) and override:
        field = override.group(1)
        if is_choice(field):
            known = ", ".join(sorted(p.stem for p in (CONFIGS / field).glob("*.yaml")))
            return (
                f"{field} is a group, not a field: {field}=... takes one of {known}, and {field}.<field>=... a value."
            )
        hint = field_hint(field, config_name, overrides)
        return f"{field} is not a field of the configuration{hint}; write +{field}=... to add an argument of your own."
    missing = re.search(r"Missing mandatory value: ([\w.]+)", text)
    if missing:
        field = getattr(error, "full_key", None) or missing.group(1)
        return f"{field} is missing; give {field}=... on the command line."
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} cannot be read; write field=value, and quote a value that holds signs of its own."
    return " ".join(text.split()).rstrip(".") + "."


def field_hint(field: str, config_name: str, overrides: Iterable[str]) -> str:
    """A bracket with the nearest field of the chosen groups, or, where none is near, with all that the group has."""
    chosen = tuple(o for o in overrides if is_choice(o))
    known = known_fields(config_name, chosen)
    group, _, last = field.rpartition(".")
    below = [k.removeprefix(f"{group}.") for k in known if group and k.startswith(f"{group}.")]
    names = sorted(n for n in below if "." not in n and not n.startswith("_"))
    if not names:
        return nearest(field, known)
    if nearest(last, names):  # names are compared alone: the group before them makes all of them look alike
        return nearest(field, [f"{group}.{n}" for n in names])
    return f" ({group} has {', '.join(names)})"


@cache
def known_fields(config_name: str, chosen: tuple[str, ...] = ()) -> list[str]:
    """Dotted names of all fields and groups of the configuration with these groups ``chosen``, or of the default one."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = OmegaConf.to_container(compose(config_name, list(chosen)), resolve=False)

    def names(node: dict, prefix: str = "") -> list[str]:
        own = [f"{prefix}{k}" for k in node]
        return own + [n for k, v in node.items() if isinstance(v, dict) for n in names(v, f"{prefix}{k}.")]

    return names(config)
