"""JSON, YAML and what comes out of them as plain data of a bounded size: words, numbers, lists and groups, and nothing else.

Texts may come from strangers. Nothing in them is run, looked up elsewhere or unfolded; what is not plain is `NotPlain`.
"""

from __future__ import annotations

import json
import math
import re

import yaml
from torch import Tensor

# More than any certificate, controller or configuration holds: values, levels, digits, bits, characters.
MOST_VALUES, MOST_OF_YAML, DEEPEST, LONGEST_NUMBER, MOST_BITS, LONGEST_SCALAR = 2**21, 2**17, 32, 64, 128, 2**13
# A value that stands for another one of the same file, a.b: the only kind of interpolation that is looked up for a file.
REFERENCE, MOST_STEPS = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}"), 8
# libyaml's parser where PyYAML has it: ten times as fast.
YAML = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NotPlain(ValueError):
    """What a file holds is not the plain data it should be; the message ends a sentence that begins with its name."""


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
    """``text`` as a YAML mapping of plain data; raises `NotPlain` for tags, references to anchors, and all but words,
    numbers, lists and mappings."""
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


def require_plain(data: object, tensors: bool = False) -> None:
    """Raise `NotPlain` unless ``data`` is made of `None`, flags, numbers and words in lists, tuples and dicts, and, with
    ``tensors``, tensors; not too many (what is shared counts each time), not too deep, and no number too long."""
    waiting, count = [(data, 0)], 0
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
        elif not (value is None or isinstance(value, float | str) or (tensors and isinstance(value, Tensor))):
            raise NotPlain(f"it holds a {type(value).__name__}, which is no word, number, list or group")


def looked_up(data: dict) -> dict:
    """``data`` with each value `${a.b}` replaced by the word or number at a.b; any other `${` raises `NotPlain`.

    A stranger's file is not given to OmegaConf: its interpolations may call functions, and unfold to any length.
    """
    return _replaced(data, data)


def _replaced(value: object, data: dict):
    if isinstance(value, dict):
        return {_literal(key): _replaced(one, data) for key, one in value.items()}
    if isinstance(value, list):
        return [_replaced(one, data) for one in value]
    for _ in range(MOST_STEPS):
        reference = REFERENCE.fullmatch(value) if isinstance(value, str) else None
        if reference is None:
            break
        found: object = data
        for key in reference[1].split("."):
            found = found.get(key) if isinstance(found, dict) else None
        if isinstance(found, dict | list):
            break
        value = found
    return _literal(value)


def _literal(value: object):
    if isinstance(value, str) and "${" in value:
        raise NotPlain(f"it holds a resolver or an interpolation, {value[:80]!r}, which is not run; write the value")
    return value
