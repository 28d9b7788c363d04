"""The configuration of a resumed run: its own, with what the command line may change in it."""

import contextlib
import copy
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ocp_torch.certificate import table
from ocp_torch.errors import InputError
from ocp_torch.files.limits import require_modest_problem, require_modest_run
from ocp_torch.files.plain import value_at
from ocp_torch.files.reading import read_json
from ocp_torch.problems import PROBLEMS
from ocp_torch.problems.commands import PACKAGE, UNKNOWN, ForeignProblem, naming
from ocp_torch.runs.configuration import CONFIG, current, saved_configuration
from ocp_torch.training.checkpoint import LAST

# Classes that a file may name; earlier names are translated before.
OWN_TARGETS = {f"{PACKAGE}.{c.__name__}" for c in PROBLEMS.values()}
# Sections that runs of earlier versions lack.
NEWER = ("sampler", "warm_start", "resume")
# Fields that a checkpoint's tensors depend on; every other field may change at a resume.
FIXED = ("problem", "method", "model", "averaging", "sampler", "warm_start", "seed", "optimizer.name", "trainer.dtype")


def find_run(composed: dict, roots: Iterable[Path]) -> Path | None:
    """The last run below ``roots`` with the configuration ``composed`` and a checkpoint; `None` if there is none."""
    depths = ("", "*/", "*/*/", "*/*/*/")
    files = [file for root in roots for depth in depths for file in root.glob(f"{depth}checkpoints/{LAST}")]
    for file in sorted(files, key=lambda file: file.stat().st_mtime, reverse=True):
        with contextlib.suppress(InputError, OSError):
            if same(saved_configuration(file.parent.parent), composed):
                return file.parent.parent
    return None


def same(one: dict, other: dict) -> bool:
    """Whether two configurations, apart from `resume`, are the same."""
    return {**current(one), "resume": None} == {**current(other), "resume": None}


def resumed_configuration(composed: dict, named: Iterable[str]) -> dict:
    """The configuration with which the run ``composed["resume"]`` goes on: its own, with the fields that the command line
    ``named`` taken from ``composed``. Raises `InputError` where a file names a problem that only a command line may name."""
    named = [name for name in named if name != "resume"]
    path = Path(str(composed["resume"]))
    saved = saved_configuration(path)
    if same(saved, composed):
        return copy.deepcopy(composed)
    if "experiment" in named:
        raise InputError("experiment cannot be given at a resume; name the fields that are to change.")
    result = {**copy.deepcopy(saved), "resume": composed["resume"]}
    for section in ("trainer", "certificate"):  # fields that are newer than the run
        if isinstance(result.get(section), dict):
            result[section] = {**composed[section], **result[section]}
    for name in named:
        _transplant(result, composed, name.split("."))
    if lost := [name for name in composed if result.get(name) is None and name not in NEWER]:
        raise InputError(
            f"the configuration of {path} is damaged: it lacks {', '.join(lost)}; remove .hydra/{CONFIG}, and that of its "
            "checkpoint is taken."
        )
    require_modest_run(path, result, {*named})
    problem: Any = result.get("problem")
    target = problem.get("_target_") if isinstance(problem, dict) else None
    if target not in OWN_TARGETS and not {"problem", "problem._target_"} & set(named):
        # A problem that is not the package's own is never imported because a file names it.
        raise ForeignProblem(
            f"the configuration of {path} names the problem {str(target)[:80]!r}, which is not part of ocp_torch and is not "
            f"imported for a file; name it yourself: problem._target_={UNKNOWN}.",
            naming({"_target_": target}, mark=""),  # its arguments are in the configuration
        )
    if target in OWN_TARGETS and "problem" not in named:
        given = {k: v for k, v in problem.items() if f"problem.{k}" not in named}
        require_modest_problem(path, given, "give it yourself, problem.<name>=..., if you want that")
    return result


def _transplant(result: dict, source: Any, keys: list[str]) -> None:
    *groups, last = keys
    for key in groups:
        source = source.get(key) if isinstance(source, dict) else None
        if not isinstance(result.get(key), dict):
            result[key] = {}
        result = result[key]
    if isinstance(source, dict) and last in source:
        result[last] = copy.deepcopy(source[last])
    else:
        result.pop(last, None)


def filled_from(config: dict, made: object) -> dict:
    """``config`` with null fields filled from ``made``, the run's configuration when it was saved: defaults by dimension may
    have changed since. Where steps are given, null rounds stay null and follow the steps, as in a new run."""
    if not isinstance(made, dict):
        return config
    filled: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, dict):
            filled[key] = filled_from(value, made.get(key))
        else:
            keep = value is not None or (key == "rounds" and config.get("steps") is not None)
            filled[key] = value if keep else made.get(key)
    return filled


def require_same_run(config: dict, made: dict) -> None:
    """Raise `InputError` when a field that the checkpoint's tensors belong to differs between ``config`` and ``made``."""
    for field in FIXED:
        _require_same(field, value_at(config, field), value_at(made, field))


def _require_same(name: str, own: object, other: object) -> None:
    if isinstance(own, dict) and isinstance(other, dict):
        for key in dict.fromkeys([*own, *other]):
            _require_same(f"{name}.{key}", own.get(key), other.get(key))
    elif own != other and not name.endswith("._target_"):
        raise InputError(
            f"{name} is {own!r}, but the run has {repr(other)[:80]}, and it cannot change at a resume; "
            "fields of trainer, certificate, optimizer, schedule and stepper can."
        )


def result_of(folder: Path, state: dict, config: dict) -> str | None:
    """The table of a run that has nothing left to do under ``config``, or `None`."""
    try:
        certificate = read_json(folder / "certificate.json")
        done = state.get("ended") and state.get("config") == config and certificate["step"] == state["step"]
        return table(certificate) if done else None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError):
        return None  # what cannot be read is made again
