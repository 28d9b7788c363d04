"""Limits on what an untrusted file may ask of the machine, which only the user may exceed; and the machine's memory."""

import os
from collections.abc import Collection
from pathlib import Path

from ocp_torch.errors import InputError
from ocp_torch.files.plain import value_at

# The largest whole number that a file may give as an argument of a problem; a `seed` may be any number.
MOST_OF_A_PROBLEM = 128
# The longest list that a file may give as an argument of a problem.
LONGEST_LIST = 256
# Dotted field of a run -> the largest value that a file may give it: some sixteen times a default.
MOST = {
    "trainer.steps": 2**24,
    "trainer.batch": 2**16,
    "trainer.threads": 64,
    "trainer.keep": 100,
    "certificate.points": 2**18,
    "certificate.replicates": 64,
    "certificate.trajectories": 2**13,
    "certificate.ascents": 2**10,
    "certificate.occupation_states": 2**12,
    "certificate.bound_steps": 2**16,
    "certificate.stage.steps": 2**14,
    "certificate.stage.rounds": 4,
    "certificate.stage.batch": 2**13,
}
LEAST = {"certificate.tolerance": 1e-9}
GIGABYTE = 1e9
# Files with the memory that a Linux container may use, in both generations of control groups.
CONTAINER_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def require_modest_problem(source: object, parameters: dict, remedy: str) -> None:
    """Raise `InputError`, which ends with ``remedy``, where a problem's argument from the file ``source`` is too large."""
    for name, parameter in parameters.items():
        waiting = [parameter]
        while waiting:
            value = waiting.pop()
            if isinstance(value, list | tuple):
                if len(value) > LONGEST_LIST:
                    raise InputError(f"{source} asks for problem.{name} of {len(value):,} entries; {remedy}.")
                waiting += [one for one in value if isinstance(one, list | tuple)]
            elif isinstance(value, int) and value > MOST_OF_A_PROBLEM and name != "seed":
                asked = f"{source} asks for problem.{name} = {value:,}"
                raise InputError(f"{asked}, and up to {MOST_OF_A_PROBLEM} is believed of a file; {remedy}.")


def require_modest_run(source: object, config: dict, named: Collection[str] = frozenset()) -> None:
    """Raise `InputError` where a field of ``config``, from the file ``source``, is beyond its limit in `MOST` or `LEAST`;
    fields that the command line ``named`` have no limit."""
    for field, limit in {**MOST, **LEAST}.items():
        value = value_at(config, field)
        if not isinstance(value, int | float) or field in named:
            continue
        if not (value >= limit if field in LEAST else value <= limit):
            bound = "at least" if field in LEAST else "up to"
            raise InputError(
                f"{source} asks for {field} = {value}, and {bound} {limit:,} is believed of a file; give {field}={value} "
                "yourself if you want that."
            )


def require_held(source: object, model: object, numbers: int) -> None:
    """Raise `InputError` where networks of the form ``model`` have more weights than the file ``source`` has ``numbers``."""
    if not isinstance(model, dict):
        return
    sizes = {name: model.get(name) for name in ("width", "depth", "modes", "waves")}
    width, depth, modes, waves = (v if isinstance(v, int) and v > 0 else 1 for v in sizes.values())
    if max(width**2 * (depth - 1), 2 * (modes + waves - 1) * width) > numbers:
        raise InputError(f"{source} describes larger networks ({sizes}) than it holds the weights of.")


def memory() -> float:
    """Bytes of memory of the machine, or of its container; infinite where neither is known."""
    found = []
    if {"SC_PHYS_PAGES", "SC_PAGE_SIZE"} <= os.sysconf_names.keys():
        found.append(float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE"))
    for limit in CONTAINER_LIMITS:
        try:
            found.append(float(limit.read_text()))
        except (OSError, ValueError):  # no such file, or it holds the word max
            continue
    return min((size for size in found if size > 0.0), default=float("inf"))


def require_memory(name: str, value: int, each: float) -> None:
    """Raise `InputError`, about the field ``name``, when ``value`` items of ``each`` bytes or more exceed the memory."""
    most = memory()
    if value * each > most:
        raise InputError(
            f"{name} is {value}, which needs {value * each / GIGABYTE:,.3g} GB of memory or more, but this machine has "
            f"{most / GIGABYTE:.3g}; at most {int(most / each)} fit."
        )
