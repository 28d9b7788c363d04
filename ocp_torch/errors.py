"""What a user is told when an input is wrong: one sentence with the field, the value and what would be right."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable


class InputError(ValueError):
    """A mistake in what the user asked for; its message is one sentence, fit to be printed without a traceback."""


def require_integer(name: str, value: object, minimum: int) -> int:
    """Return ``value`` if it is a whole number of at least ``minimum``; raise `InputError` otherwise."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"{name} is {value!r}, but must be a whole number of at least {minimum}.")
    if value < minimum:
        raise InputError(f"{name} is {value}, but must be at least {minimum}.")
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
