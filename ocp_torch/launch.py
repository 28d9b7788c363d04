"""The glue between Hydra and the package: folders, friendly errors, and checks before anything is written."""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import (
    ConfigCompositionException,
    HydraException,
    MissingConfigException,
    OverrideParseException,
)
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ocp_torch.config import problem_class
from ocp_torch.errors import InputError, nearest

CHECKOUT = Path(__file__).resolve().parent.parent
CONFIGS = CHECKOUT / "configs"
FAILED_INPUT = 2


def register_resolvers() -> None:
    """`${checkout:outputs}`: a folder of the checkout wherever a run starts; `${problem_name:a.b.Circle}`: circle."""
    OmegaConf.register_new_resolver("checkout", lambda part: str(CHECKOUT / part), replace=True)
    OmegaConf.register_new_resolver("problem_name", lambda target: str(target).rpartition(".")[2].lower(), replace=True)


def plain(config: DictConfig) -> dict:
    """The configuration as nested plain data, interpolations resolved."""
    data = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    data.pop("hydra", None)
    return data


def drop_unclaimed(problem: dict, overrides: list[str]) -> dict:
    """Without the group's own fields that a user's class does not take; those the user set himself stay, to be refused."""
    target = str(problem.get("_target_"))
    if target.startswith("ocp_torch."):
        return problem
    own = [o.lstrip("+") for o in overrides if o.lstrip("+").startswith("problem.")]
    named = {o.split("=")[0].removeprefix("problem.") for o in own}
    taken = inspect.signature(problem_class(problem.get("_target_"))).parameters
    return {k: v for k, v in problem.items() if k == "_target_" or k in taken or k in named}


def launch(entry: Callable, config_name: str, check: Callable[[dict], object]) -> None:
    """Run the Hydra ``entry``; a single run is composed and handed to ``check`` first, before any folder is made.

    A user's mistake ends in one sentence on stderr and exit status 2.
    """
    register_resolvers()
    # A user's module is found where the command was given, as `python -m` would find it.
    sys.path.insert(0, os.getcwd())
    arguments = sys.argv[1:]
    if not any(
        a in ("-m", "--multirun", "--help", "-h", "--info", "-i", "--cfg", "-c", "--hydra-help") for a in arguments
    ):
        overrides = [a for a in arguments if not a.startswith("-")]
        try:
            check(composed(config_name, overrides))
        except InputError as error:
            fail(str(error))
    entry()


def composed(config_name: str, overrides: list[str]) -> dict:
    """What the job will be given; whatever Hydra or OmegaConf has against it becomes an `InputError` of one sentence."""
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            return prepared(plain(compose(config_name, overrides)), overrides)
    except (HydraException, OmegaConfBaseException, ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        known = isinstance(error, HydraException | OmegaConfBaseException)
        # Hydra has no exception of its own for some slips, and does not say where they are.
        sentence = explain(error, config_name) if known else f"{' '.join(overrides)} cannot be composed: {error}."
        raise InputError(sentence) from None
    finally:
        GlobalHydra.instance().clear()


def prepared(data: dict, overrides: list[str]) -> dict:
    """``data`` with the problem's fields reduced to those its class takes."""
    if isinstance(data.get("problem"), dict) and "_target_" in data["problem"]:
        data["problem"] = drop_unclaimed(data["problem"], overrides)
    return data


def fail(sentence: str) -> None:
    """Print one sentence and leave with the status of a wrong input."""
    print(f"error: {sentence}", file=sys.stderr)
    sys.exit(FAILED_INPUT)


def job(task: Callable[[dict, Path], object], config: DictConfig) -> None:
    """Run ``task(config, folder)`` as a Hydra job. In a sweep a wrong input ends its own job only."""
    hydra = HydraConfig.get()
    try:
        task(prepared(plain(config), list(hydra.overrides.task)), Path(hydra.runtime.output_dir))
    except InputError as error:
        if hydra.mode == RunMode.MULTIRUN:
            print(f"error: job {hydra.job.num} ({hydra.job.override_dirname}): {error}", file=sys.stderr)
            failed_jobs.append(hydra.job.override_dirname)
            return
        fail(str(error))


failed_jobs: list[str] = []


def finish() -> None:
    """After a sweep: name the jobs that failed and leave with their status."""
    if failed_jobs:
        fail(f"{len(failed_jobs)} job(s) of the sweep failed: {'; '.join(failed_jobs)}.")


def explain(error: Exception, config_name: str) -> str:
    """Hydra's and OmegaConf's own words as one sentence."""
    text = str(error)
    unknown = re.search(r"Could not find '([\w./-]+)/([^'/]*)'", text)
    if isinstance(error, MissingConfigException) and unknown:
        group, choice = unknown.groups()
        known = sorted(p.stem for p in (CONFIGS / group).glob("*.yaml"))
        return f"{group} is {choice!r}, but must be one of {', '.join(known)}{nearest(choice, known)}."
    override = re.search(r"Could not override '([\w.]+)'", text)
    if isinstance(error, ConfigCompositionException) and override:
        field = override.group(1)
        known = known_fields(config_name)
        hint = nearest(field, known)
        return f"{field} is not a field of the configuration{hint}; write +{field}=... to add an argument of your own."
    missing = re.search(r"Missing mandatory value: ([\w.]+)", text)
    if missing:
        field = getattr(error, "full_key", None) or missing.group(1)
        return f"{field} is missing; give {field}=... on the command line."
    if isinstance(error, OverrideParseException):
        return f"{error.override!r} cannot be read; write field=value, and quote a value that holds signs of its own."
    return " ".join(text.split()).rstrip(".") + "."


def known_fields(config_name: str) -> list[str]:
    """Dotted names of all fields and groups of the default configuration."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = OmegaConf.to_container(compose(config_name), resolve=False)

    def names(node: dict, prefix: str = "") -> list[str]:
        own = [f"{prefix}{k}" for k in node]
        return own + [n for k, v in node.items() if isinstance(v, dict) for n in names(v, f"{prefix}{k}.")]

    return names(config)
