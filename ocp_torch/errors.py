"""What a user is told when an input is wrong: one sentence with the field, the value and what would be right."""

import difflib
import inspect
import math
from collections.abc import Callable, Iterable, Sequence

# A sentence that quotes more has nothing more to say; and a run that has more to warn of was not written by a run.
LONGEST, MOST_NOTES = 2000, 200


def visible(text: object, most: int = LONGEST, keep: str = "") -> str:
    """``text`` fit for a terminal: what does not print, but for the signs in ``keep``, as its escape (`\\x1b`), and what is
    longer than ``most`` without its middle. Names, notes and messages may come from files of strangers."""
    text = str(text)
    if len(text) > most:
        text = f"{text[: 3 * most // 4]} ... {text[-most // 5 :]}"
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else c.encode("unicode_escape").decode() for c in text)


def first_line(error: BaseException) -> str:
    """The first line of what ``error`` says, without its full stop, for a sentence of ours."""
    return next(iter(str(error).splitlines()), "").rstrip(".?!") or "no message"


def notes(found: object) -> tuple[str, ...]:
    """The sentences ``found`` in a file, `visible`; `InputError` where it is no list of them, or an endless one."""
    if not isinstance(found, list | tuple) or len(found) > MOST_NOTES or not all(isinstance(n, str) for n in found):
        raise InputError(
            f"the warnings in the file are {visible(found, 80)}, but must be at most {MOST_NOTES} sentences."
        )
    return tuple(visible(note) for note in found)


class InputError(ValueError):
    """A mistake in what the user asked for; its message is one sentence, fit to be printed without a traceback."""

    def __str__(self) -> str:
        return visible(super().__str__())


class ProblemError(InputError):
    """A user's problem failed: its code raised, or gave what no problem may. The sentence says which function, and where."""


class StorageError(InputError):
    """A file that could not be written: no space, no permission. What was there before is untouched."""


# No number of a problem or a run needs to be larger, or nearer to 0 where 0 is out; single precision ends at 3e38.
LARGEST, SMALLEST = 1e30, 1e-30
# Of a value that is wrong, no more is repeated.
LONGEST_SHOWN = 80


def shown(value: object) -> str:
    """``value`` as a sentence can hold it: short, and on one line."""
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 64:
        return f"a whole number of about {int(value.bit_length() * math.log10(2.0)) + 1} digits"
    try:
        text = repr(value)
    except ValueError:  # a list with a number of more digits than Python prints
        text = f"a {type(value).__name__}"
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}..."


def require_integer(name: str, value: object, minimum: int, maximum: int = 2**31 - 1) -> int:
    """Return ``value`` if it is a whole number from ``minimum`` to ``maximum``; raise `InputError` otherwise."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"{name} is {shown(value)}, but must be a whole number of at least {minimum}.")
    if value < minimum:
        raise InputError(f"{name} is {shown(value)}, but must be at least {minimum}.")
    if value > maximum:
        raise InputError(f"{name} is {shown(value)}, but must be at most {maximum}.")
    return value


def require_number(
    name: str,
    value: object,
    *,
    above: float | None = None,
    at_least: float | None = None,
    at_most: float | None = None,
) -> float:
    """Return ``value`` as a finite float inside the stated range, or at most `LARGEST` in size; else raise `InputError`."""
    limits = [f"above {above:g}" if above is not None else "", f"at least {at_least:g}" if at_least is not None else ""]
    limits.append(f"at most {at_most:g}" if at_most is not None else "")
    wanted = " and ".join(limit for limit in limits if limit) or "finite"
    try:
        number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
    except OverflowError:  # a whole number that no float can hold
        number = math.inf
    if not math.isfinite(number):
        raise InputError(
            f"{name} is {shown(value)}, but must be a finite number{', ' + wanted if any(limits) else ''}."
        )
    if at_most is None and abs(number) > LARGEST:
        raise InputError(f"{name} is {number:g}, but must be a number of at most {LARGEST:g} in size.")
    if above == 0.0 and 0.0 < number < SMALLEST:
        raise InputError(f"{name} is {number:g}, but must be at least {SMALLEST:g}.")
    outside = (
        (above is not None and number <= above)
        or (at_least is not None and number < at_least)
        or (at_most is not None and number > at_most)
    )
    if outside:
        raise InputError(f"{name} is {number:g}, but must be {wanted}.")
    return number


def require_numbers(name: str, value: object, count: int | None = None, above: float | None = None) -> list[float]:
    """``value`` as a list of finite floats, ``count`` of them and each ``above`` a number where given; else `InputError`."""
    if isinstance(value, str) or not isinstance(value, Sequence) or (count is not None and len(value) != count):
        wanted = "a list of" + (f" {count}" if count is not None else "") + " numbers"
        raise InputError(f"{name} is {shown(value)}, but must be {wanted}.")
    return [require_number(f"{name}[{i}]", v, above=above) for i, v in enumerate(value)]


def require_flag(name: str, value: object) -> bool:
    """Return ``value`` if it is a boolean; raise `InputError` otherwise."""
    if not isinstance(value, bool):
        raise InputError(f"{name} is {shown(value)}, but must be true or false.")
    return value


def require_choice(name: str, value: object, choices: Iterable[str]) -> str:
    """Return ``value`` if it is one of ``choices``; raise `InputError`, with the nearest name, otherwise."""
    known = sorted(choices)
    if not isinstance(value, str) or value not in known:
        raise InputError(
            f"{name} is {shown(value)}, but must be one of {', '.join(known)}{nearest(str(value), known)}."
        )
    return str(value)


def nearest(word: str, known: Iterable[str]) -> str:
    """The suffix `` (did you mean 'circle'?)``, or nothing when no known name is close."""
    close = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""


def require_section(name: str, value: object) -> dict:
    """Return a copy of ``value`` if it is a group of named fields; raise `InputError` otherwise."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{name} is {shown(value)}, but must be a group of fields.")
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
