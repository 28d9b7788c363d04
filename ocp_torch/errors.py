"""What a user is told when an input is wrong: one sentence with the field, the value and what would be right."""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterable


class InputError(ValueError):
    """A mistake in what the user asked for; its message is one sentence, fit to be printed without a traceback."""


class ProblemError(InputError):
    """A user's problem failed: its code raised, or gave what no problem may. The sentence says which function, and where."""


class StorageError(InputError):
    """A file that could not be written: no space, no permission. What was there before is untouched."""


def require_integer(name: str, value: object, minimum: int, maximum: int = 2**31 - 1) -> int:
    """Return ``value`` if it is a whole number from ``minimum`` to ``maximum``; raise `InputError` otherwise."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"{name} is {value!r}, but must be a whole number of at least {minimum}.")
    if value < minimum:
        raise InputError(f"{name} is {value}, but must be at least {minimum}.")
    if value > maximum:
        raise InputError(f"{name} is {value:.6g}, but must be at most {maximum}.")
    return value


def require_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return ``value`` as a finite float inside the stated range; raise `InputError` otherwise."""
    limits = [f"above {above:g}" if above is not None else "", f"at least {at_least:g}" if at_least is not None else ""]
    limits.append(f"at most {at_most:g}" if at_most is not None else "")
    wanted = " and ".join(limit for limit in limits if limit) or "finite"
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{name} is {value!r}, but must be a finite number{', ' + wanted if any(limits) else ''}.")
    number = float(value)
    outside = (
        (above is not None and number <= above)
        or (at_least is not None and number < at_least)
        or (at_most is not None and number > at_most)
    )
    if outside:
        raise InputError(f"{name} is {value:g}, but must be {wanted}.")
    return number


def require_flag(name: str, value: object) -> bool:
    """Return ``value`` if it is a boolean; raise `InputError` otherwise."""
    if not isinstance(value, bool):
        raise InputError(f"{name} is {value!r}, but must be true or false.")
    return value


def require_choice(name: str, value: object, choices: Iterable[str]) -> str:
    """Return ``value`` if it is one of ``choices``; raise `InputError`, with the nearest name, otherwise."""
    known = sorted(choices)
    if value not in known:
        raise InputError(f"{name} is {value!r}, but must be one of {', '.join(known)}{nearest(str(value), known)}.")
    return str(value)


def nearest(word: str, known: Iterable[str]) -> str:
    """The suffix `` (did you mean 'circle'?)``, or nothing when no known name is close."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def require_section(name: str, value: object) -> dict:
    """Return a copy of ``value`` if it is a group of named fields; raise `InputError` otherwise."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{name} is {value!r}, but must be a group of fields.")
    return dict(value)


def require_call(what: Callable, field: str, options: dict, **given) -> None:
    """Check that ``what(**given, **options)`` has a name for each argument; raise `InputError`, naming ``field``, if not."""
    parameters = inspect.signature(what).parameters
    known = [name for name in parameters if name not in given]
    if not any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
        for name in options:
            if name not in known:
                takes = ", ".join(known) or "nothing"
                raise InputError(f"{field}.{name} is not a field of {field}{nearest(name, known)}; it takes {takes}.")
    for name, parameter in parameters.items():
        required = parameter.default is parameter.empty and parameter.kind is parameter.POSITIONAL_OR_KEYWORD
        if required and name not in options and name not in given:
            raise InputError(f"{field}.{name} is missing; give {field}.{name}=... on the command line.")


def call(what: Callable, field: str, options: dict, **given):
    """``what(**given, **options)``; an argument it does not take or lacks is an `InputError` that names ``field``."""
    require_call(what, field, options, **given)
    return what(**given, **options)
