"""The door through which files come in: ordinary files of a bounded size, and JSON and YAML as plain data of a bounded one.

Files may come from strangers. Whatever they hold, reading ends, in little memory, with plain data or an `InputError`.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import stat
import zipfile
from collections.abc import Iterable
from fnmatch import fnmatch
from pathlib import Path
from typing import BinaryIO

import yaml
from torch import Tensor

from ocp_torch.errors import InputError

FILE, FOLDER, OTHER = "file", "folder", "other"
# No run writes a larger file; a larger one is not read into memory.
LARGEST_FILE = 2**31
# More than any certificate, controller or configuration holds: text in bytes, values, levels, digits, bits, characters.
LARGEST_JSON, LARGEST_YAML, MOST_OF_YAML = 2**26, 2**20, 2**17
MOST_VALUES, DEEPEST, LONGEST_NUMBER, MOST_BITS, LONGEST_SCALAR = 2**21, 32, 64, 128, 2**13
# Of an archive what is read at once at most: its list of parts has 50 bytes and more for each.
LARGEST_PIECE = 2**20
# What a run writes in its folder.
WRITTEN = (".hydra", "checkpoints", "figures", "*.log", "*.json", "*.safetensors", "events.*")
# A value that stands for another one of the same file, a.b: the only kind of interpolation that is looked up for a file.
REFERENCE, MOST_STEPS = re.compile(r"\$\{([A-Za-z_]\w*(?:\.\w+)*)\}"), 8
# libyaml's parser where PyYAML has it: ten times as fast.
YAML = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class NotPlain(ValueError):
    """What a file holds is not the plain data it should be; the message ends a sentence that begins with its name."""


def kind(path: str | Path) -> str | None:
    """``FILE``, ``FOLDER`` or ``OTHER`` (a pipe, a device, a socket), links followed; `None` where there is nothing.

    Raises `InputError` for a path that cannot be looked at: too long, in a folder that may not be entered, in a circle.
    """
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
        shown = f"{str(path)[:80]!r}... ({len(str(path)):,} characters)" if long else repr(str(path))
        raise InputError(f"{shown} is not a path that can be read: {reason}.") from None
    return FILE if stat.S_ISREG(mode) else FOLDER if stat.S_ISDIR(mode) else OTHER


def require_file(path: str | Path, most: int = LARGEST_FILE) -> None:
    """Raise `InputError` unless ``path`` is an ordinary file of at most ``most`` bytes."""
    found = kind(path)
    if found != FILE:
        what = {None: "does not exist", FOLDER: "is a folder"}.get(found, "is a pipe or a device")
        raise InputError(f"{path} {what}, but must be an ordinary file.")
    size = os.stat(path).st_size
    if size > most:
        raise InputError(f"{path} has {size:,} bytes, but at most {most:,} are read.")


def opened(path: str | Path, most: int = LARGEST_FILE) -> BinaryIO:
    """The ordinary file ``path``, of at most ``most`` bytes, open for reading. Raises `InputError` for anything else."""
    require_file(path, most)
    try:
        # Should a pipe have taken the file's place meanwhile, opening it does not wait.
        file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise InputError(f"{path} is a pipe or a device, but must be an ordinary file.")
    return file


def read_text(path: str | Path, most: int) -> str:
    """The UTF-8 text of an ordinary file of at most ``most`` bytes; `InputError` otherwise."""
    try:
        with opened(path, most) as file:
            return (file.read(most) or b"").decode()
    except UnicodeDecodeError:
        raise InputError(f"{path} is damaged: it is not UTF-8 text.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None


def read_json(path: str | Path, most: int = LARGEST_JSON) -> dict:
    """The JSON object in the file ``path``; `InputError`, naming the file, where there is none, or a crafted one."""
    text = read_text(path, most)
    try:
        return json_object(text)
    except NotPlain as error:
        raise InputError(f"{path} is damaged: {error}.") from None


def read_yaml(path: str | Path) -> dict:
    """The YAML mapping in the file ``path`` with its references looked up; `InputError`, naming the file, otherwise."""
    text = read_text(path, LARGEST_YAML)
    try:
        return looked_up(yaml_mapping(text))
    except NotPlain as error:
        raise InputError(f"{path} is damaged or not a run's configuration: {error}.") from None


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


class _Frugal:
    """An open file that is read in small pieces only."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, lambda: True

    def read(self, count: int = -1) -> bytes:
        data = self._file.read(LARGEST_PIECE + 1 if count < 0 else min(count, LARGEST_PIECE + 1))
        if len(data) > LARGEST_PIECE:
            raise ValueError("it lists too many parts")
        return data


def zip_file(file: BinaryIO) -> zipfile.ZipFile:
    """The ZIP archive in ``file``, whose list of parts is read at once; raises `ValueError` where that is too long."""
    return zipfile.ZipFile(_Frugal(file))


def require_unlinked(folder: Path, names: Iterable[str] = WRITTEN) -> None:
    """Raise `InputError` where an entry of ``folder`` that is about to be written, by the patterns ``names``, is a link, a
    pipe or a device, or holds one.

    A link would lead what is written somewhere else; a pipe would keep the run waiting. ``folder`` itself may be a link:
    it is the user who named it.
    """
    entries = [entry for entry in _entries(str(folder)) if any(fnmatch(entry.name, name) for name in names)]
    while entries:
        entry = entries.pop()
        status = entry.stat(follow_symlinks=False)
        if stat.S_ISDIR(status.st_mode):
            entries += _entries(entry.path)
            continue
        # Logs are continued in place; everything else is replaced as a whole.
        second = status.st_nlink > 1 and entry.name.endswith(".log")
        if stat.S_ISLNK(status.st_mode) or second:
            wrong = "a link to another file"
        elif stat.S_ISREG(status.st_mode):
            continue
        else:
            wrong = "a pipe or a device"
        raise InputError(
            f"{entry.path} is {wrong}, and nothing is written into a folder that holds one; remove it, or copy the run."
        )


def _entries(folder: str) -> list[os.DirEntry]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}.") from None
