"""The door through which files come in, and the one through which a run's folder is written: ordinary files alone.

Files may come from strangers. Whatever they hold, reading ends, in little memory, with plain data or an `InputError`.
"""

from __future__ import annotations

import errno
import os
import stat
import zipfile
from collections.abc import Iterable
from fnmatch import fnmatch
from pathlib import Path
from typing import BinaryIO

from ocp_torch.errors import InputError
from ocp_torch.files.plain import NotPlain, json_object, looked_up, yaml_mapping

FILE, FOLDER, OTHER = "file", "folder", "other"
# No run writes a larger file; a larger one is not read into memory.
LARGEST_FILE = 2**31
# More bytes of text than any certificate, controller or configuration has.
LARGEST_JSON, LARGEST_YAML = 2**26, 2**20
# Of an archive what is read at once at most: its list of parts has 50 bytes and more for each.
LARGEST_PIECE = 2**20
# What a run writes in its folder.
WRITTEN = (".hydra", "checkpoints", "figures", "*.log", "*.json", "*.safetensors", "events.*")


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
