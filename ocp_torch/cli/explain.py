"""Errors of Hydra and OmegaConf in one sentence each, with what would be right."""

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf

from ocp_torch.errors import nearest

PACKAGE = Path(__file__).resolve().parents[1]
CHECKOUT = PACKAGE.parent
# A wheel holds the configurations within the package.
INSTALLED = (PACKAGE / "configs").is_dir()
CONFIGS = (PACKAGE if INSTALLED else CHECKOUT) / "configs"


def explain(error: Exception, config_name: str, overrides: Iterable[str] = ()) -> str:
    """A sentence on ``error``, of Hydra or OmegaConf, about the command line; ``overrides`` name the chosen groups."""
    text = str(error)
    unknown = re.search(r"Could not find '([\w./-]+)/([^'/]*)'", text)
    if isinstance(error, MissingConfigException) and unknown:
        group, choice = unknown.groups()
        if group == "hydra/launcher":
            brings = "'.[parallel]' brings joblib, '.[cluster]' submitit_slurm and submitit_local"
            return f"{group} is {choice!r}, which is not installed; pip install -e {brings}."
        group, _, choice = f"{group}/{choice}".partition("/")  # as in problem=./mine.py
        known = choices(group)
        hint, file = nearest(choice, known), Path(choice)
        is_yaml = file.suffix in (".yaml", ".yml")
        if file.stem in known and (is_yaml or not file.suffix):  # the path of one of them
            hint = f"; write {group}={file.stem}"
        elif is_yaml:
            hint = f"; a file of your own cannot be given, but its fields can, {group}.<field>=<value>"
        elif group == "problem" and not hint:
            hint = f"; a class of your own in the folder you start from is problem._target_={own_class(choice)}"
        return f"{group} is {choice!r}, but must be one of {', '.join(known)}{hint}."
    override = re.search(r"Could not override '([\w.@/-]+)'", text)
    if isinstance(error, ConfigCompositionException) and override:
        field = override.group(1)
        if is_choice(field):
            takes = f"{field}=... takes one of {', '.join(choices(field))}, and {field}.<field>=... a value"
            return f"{field} is a group, not a field: {takes}."
        hint = field_hint(field, config_name, overrides)
        add = f"; write +{field}=... to add an argument of your own" if "." in field else ""
        return f"{field} is not a field of the configuration{hint}{add}."
    missing = re.search(r"Missing mandatory value: ([\w.]+)", text)
    if missing:
        field = getattr(error, "full_key", None) or missing.group(1)
        return f"{field} is missing; give {field}=... on the command line."
    if isinstance(error, OverrideParseException):
        quoted = "quote a value that holds signs of its own, within the quotes of the shell, as in \"run='my runs/1'\""
        return f"{error.override!r} cannot be read; write field=value, and {quoted}."
    return " ".join(text.split()).rstrip(".") + "."


def own_class(given: str) -> str:
    """How a class is written that was meant by `mine.py`, `./mine.py:Class` or `mine.Class`, as far as ``given`` says it."""
    module, _, name = given.rpartition("/")[2].replace(".py", "").replace(":", ".").partition(".")
    return f"{module or 'my_module'}.{name or 'MyProblem'}"


def is_choice(override: str) -> bool:
    """Whether ``override`` chooses a file of a group, rather than setting a field."""
    return (CONFIGS / override.lstrip("+~").split("=")[0].partition("@")[0]).is_dir()


def choices(group: str) -> list[str]:
    """The names of the files of a ``group``, without suffix."""
    return sorted(p.stem for p in (CONFIGS / group).glob("*.yaml"))


def field_hint(field: str, config_name: str, overrides: Iterable[str]) -> str:
    """A hint in brackets: the nearest field of the chosen groups, or, where none is near, all fields of the group."""
    known = known_fields(config_name, tuple(o for o in overrides if is_choice(o)))
    group, _, last = field.rpartition(".")
    below = [k.removeprefix(f"{group}.") for k in known if group and k.startswith(f"{group}.")]
    names = sorted(n for n in below if "." not in n and not n.startswith("_"))
    if not names:
        return nearest(field, known)
    if nearest(last, names):  # compared without their groups, which would make all of them alike
        return nearest(field, [f"{group}.{n}" for n in names])
    return f" ({group} has {', '.join(names)})"


@cache
def known_fields(config_name: str, chosen: tuple[str, ...] = ()) -> list[str]:
    """Dotted names of all fields and groups of the configuration with these groups ``chosen``, or of the default one."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config: Any = OmegaConf.to_container(compose(config_name, list(chosen)), resolve=False)

    def names(node: dict, prefix: str = "") -> list[str]:
        own = [f"{prefix}{k}" for k in node]
        return own + [n for k, v in node.items() if isinstance(v, dict) for n in names(v, f"{prefix}{k}.")]

    return names(config)
