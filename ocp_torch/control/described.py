"""The problem of a controller as its file names it, and whether another is the same."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ocp_torch.errors import InputError
from ocp_torch.files.plain import DEEPEST
from ocp_torch.files.storage import finite
from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.physical.system import System


def problem_name(problem: Problem) -> str:
    """The name of a built-in problem, or the class name of a user's own in lower case (with its module if that is taken)."""
    cls = type(problem)
    own = cls.__name__.lower()
    return next((n for n, c in PROBLEMS.items() if c is cls), own if own not in PROBLEMS else f"{cls.__module__}.{own}")


def plain_parameters(parameters: dict) -> dict:
    """The ``parameters`` of a problem that JSON can hold. Only a user's own problem, given on loading, may have others."""
    return {name: _listed(value) for name, value in parameters.items() if _is_plain(value)}


def _is_plain(value: object, depth: int = 0) -> bool:
    """Whether JSON can hold ``value``, within ``depth`` others, with all that is in it; not where that has no end."""
    if isinstance(value, Mapping):
        return all(isinstance(key, str) for key in value) and _is_plain([*value.values()], depth)
    if isinstance(value, list | tuple):
        return depth < DEEPEST and all(_is_plain(own, depth + 1) for own in value)
    return isinstance(value, bool | int | float | str | type(None))


def _listed(value: Any) -> Any:
    """``value`` as JSON gives it back: lists for tuples."""
    if isinstance(value, Mapping):
        return {key: _listed(own) for key, own in value.items()}
    return [_listed(own) for own in value] if isinstance(value, list | tuple) else value


def described(problem: Problem) -> dict:
    """What a file says of ``problem``: its name, the arguments that make it again, and its units where it has some."""
    # The units of a data set are in its file, which a saved controller does without.
    units = problem.measures if isinstance(problem, System) else None
    parameters = plain_parameters(problem.parameters)
    return {"name": problem_name(problem), "parameters": parameters, **(units.plain if units else {})}


def require_same(path: Path, problem: Problem, saved: dict) -> None:
    """Raise `InputError` where ``problem`` is not made, or not measured, as that of the run, ``saved``, was."""
    given = finite(described(problem))
    own = {k: v for k, v in given["parameters"].items() if k not in problem.incidental}
    units = {k: v for k, v in given.items() if k not in ("name", "parameters")}
    for group, before in ((own, saved["parameters"]), (units, saved)):
        if other := [name for name in group if name in before and group[name] != before[name]]:
            mine = " and ".join(f"problem.{name} is {group[name]!r:.80}" for name in other)
            theirs = " and ".join(f"{before[name]!r:.80}" for name in other)
            raise InputError(
                f"{mine}, but the run of {path} has {theirs}; a controller is loaded with the problem it was trained for."
            )
