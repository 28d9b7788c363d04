"""JSON and YAML from untrusted files as plain data of bounded size: words, numbers, lists and groups. No code is run."""

import json
import math
import re
from typing import Any

import yaml
from torch import Tensor

# Limits that no certificate, controller or configuration reaches.
MOST_VALUES = 2**21  # values in a file
MOST_OF_YAML = 2**17  # values in YAML
DEEPEST = 32  # levels of nesting
LONGEST_NUMBER = 64  # characters of a number in JSON
MOST_BITS = 128  # of a whole number
LONGEST_SCALAR = 2**13  # characters of a value in YAML
# `${a.b}` stands for the value at a.b of the same file.
REFERENCE = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}")
# References that lead to references, at most.
MOST_STEPS = 8
# The parser of the C library, where PyYAML has it, is ten times as fast.
YAML = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NotPlain(ValueError):
    """A file does not hold the plain data it should; the message is to follow the name of the file and a colon."""


def json_object(text: str) -> dict:
    """``text`` as a JSON object of plain data; raises `NotPlain`."""
    if sum(text.count(sign) for sign in "[{,") > MOST_VALUES:
        raise NotPlain(f"it holds more than {MOST_VALUES:,} values")
    try:
        data = json.loads(text, parse_int=_integer, parse_float=_float, parse_constant=_float)
    except NotPlain:
        raise
    except (ValueError, RecursionError):
        raise NotPlain("it is not JSON") from None
    if not isinstance(data, dict):
        raise NotPlain("it is not a JSON object")
    require_plain(data)
    return data


def yaml_mapping(text: str) -> dict:
    """``text`` as a YAML mapping of plain data; raises `NotPlain`, also for tags and for references to anchors."""
    depth = 0
    try:
        for count, event in enumerate(yaml.parse(text, Loader=YAML)):
            if count > MOST_OF_YAML:
                raise NotPlain(f"it holds more than {MOST_OF_YAML:,} values")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST or isinstance(event, yaml.AliasEvent):
                raise NotPlain("it holds references or nests too deep, which no run's configuration does")
            if getattr(event, "tag", None) is not None:
                raise NotPlain(f"it holds the tag {event.tag[:80]!r}, and no run's configuration has tags")
            if isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_SCALAR:
                raise NotPlain(f"it holds a value of {len(event.value):,} characters")
        data = yaml.load(text, Loader=YAML)
    except NotPlain:
        raise
    except (ValueError, RecursionError, OverflowError, yaml.YAMLError) as error:
        raise NotPlain(" ".join(str(error).split())[:200].rstrip(".")) from None
    if not isinstance(data, dict):
        raise NotPlain("it is not a mapping")
    require_plain(data)
    return data


def _integer(digits: str) -> int:
    if len(digits) > LONGEST_NUMBER:
        raise NotPlain(f"it holds a number of {len(digits):,} digits")
    return int(digits)


def _float(digits: str) -> float:
    if len(digits) > LONGEST_NUMBER or not math.isfinite(float(digits)):
        raise NotPlain(f"it holds the number {digits[:20]}, of {len(digits):,} signs, which is too long or not finite")
    return float(digits)


def require_plain(data: object, tensors: bool = False) -> list[Tensor]:
    """Raise `NotPlain` unless ``data`` is made of `None`, flags, numbers and words in lists, tuples and dicts, or where it
    has too many values (one in several places counts each time), too deep ones or a too long number. Where ``tensors`` are
    allowed, they are returned."""
    found, waiting, count = [], [(data, 0)], 0
    while waiting:
        value, depth = waiting.pop()
        count += 1
        if isinstance(value, dict | list | tuple):
            inner = (*value, *value.values()) if isinstance(value, dict) else value
            if isinstance(value, dict) and not all(isinstance(key, str | int) for key in value):
                raise NotPlain("it holds a group with a name that is no word")
            if depth >= DEEPEST:
                raise NotPlain(f"it nests deeper than {DEEPEST} levels")
            if count + len(waiting) + len(inner) > MOST_VALUES:
                raise NotPlain(f"it holds more than {MOST_VALUES:,} values")
            waiting += [(one, depth + 1) for one in inner]
        elif isinstance(value, int):
            if value.bit_length() > MOST_BITS:
                raise NotPlain(f"it holds a whole number of {value.bit_length():,} bits")
        elif tensors and isinstance(value, Tensor):
            found.append(value)
        elif not (value is None or isinstance(value, float | str)):
            raise NotPlain(f"it holds a {type(value).__name__}, which is no word, number, list or group")
    return found


def value_at(data: object, field: str) -> Any:
    """The value at the dotted ``field``, a.b, of nested ``data``; `None` where there is none."""
    for key in field.split("."):
        data = data.get(key) if isinstance(data, dict) else None
    return data


def looked_up(value: Any, data: dict | None = None) -> Any:
    """``value``, the whole of a file or a part of its ``data``, with each `${a.b}` replaced by the word or number at a.b.
    Raises `NotPlain` for any other `${`, as OmegaConf's resolvers may call functions."""
    data = value if data is None else data
    if isinstance(value, dict):
        return {_literal(key): looked_up(one, data) for key, one in value.items()}
    if isinstance(value, list):
        return [looked_up(one, data) for one in value]
    for _ in range(MOST_STEPS):
        reference = REFERENCE.fullmatch(value) if isinstance(value, str) else None
        if reference is None or isinstance(found := value_at(data, reference[1]), dict | list):
            break
        value = found
    return _literal(value)


def _literal(value: object):
    if isinstance(value, str) and "${" in value:
        raise NotPlain(f"it holds a resolver or an interpolation, {value[:80]!r}, which is not run; write the value")
    return value
