"""Reading ordinary files, also untrusted ones, in little memory; and checking that a run writes to ordinary files only."""

import errno
import os
import stat
from collections.abc import Iterable
from fnmatch import fnmatch
from pathlib import Path
from typing import BinaryIO, cast
from zipfile import ZipFile

from ocp_torch.errors import InputError, shown
from ocp_torch.files.plain import NotPlain, json_object, looked_up, yaml_mapping

# Kinds of paths.
FILE = "file"
FOLDER = "folder"
OTHER = "other"
# Bytes of a file that is read, at most; no run writes a larger one.
LARGEST_FILE = 2**31
# Bytes of JSON that is read, at most: more than any certificate or controller has.
LARGEST_JSON = 2**26
# Bytes of YAML that is read, at most: more than any configuration has.
LARGEST_YAML = 2**20
# Bytes of a ZIP archive that are read at once, at most. Its list of parts is read at once, with 50 bytes or more for each.
LARGEST_PIECE = 2**20
# Names of what a run writes in its folder.
WRITTEN = (".hydra", "checkpoints", "figures", "*.log", "*.json", "*.html", "*.safetensors", "events.*")


def require_path(name: str, value: object) -> Path:
    """``value`` as a path; raises `InputError`, about what ``name`` is, where it is none."""
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name} is {shown(value)}, but must be a path, as in 'outputs/circle_pd'.")
    return Path(value)


def kind(path: str | Path) -> str | None:
    """``FILE``, ``FOLDER`` or ``OTHER`` (a pipe, a device, a socket), links followed; `None` where there is nothing. Raises
    `InputError` where the path is too long, in a folder that may not be entered, or a circle of links."""
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        long = isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG
        named = f"{str(path)[:80]!r}... ({len(str(path)):,} characters)" if long else repr(str(path))
        raise InputError(f"{named} is not a path that can be read: {reason}.") from None
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
        # Non-blocking, in case a pipe has taken the file's place meanwhile.
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
    """The JSON object in the file ``path``, of at most ``most`` bytes; `InputError`, with its name, otherwise."""
    try:
        return json_object(read_text(path, most))
    except NotPlain as error:
        raise InputError(f"{path} is damaged: {error}.") from None


def read_yaml(path: str | Path) -> dict:
    """The YAML mapping in the file ``path``, its references looked up; `InputError`, with its name, otherwise."""
    try:
        return looked_up(yaml_mapping(read_text(path, LARGEST_YAML)))
    except NotPlain as error:
        raise InputError(f"{path} is damaged or not a run's configuration: {error}.") from None


class _Frugal:
    """An open file that raises `ValueError` where more than `LARGEST_PIECE` bytes are read at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, lambda: True

    def read(self, count: int = -1) -> bytes:
        data = self._file.read(LARGEST_PIECE + 1 if count < 0 else min(count, LARGEST_PIECE + 1))
        if len(data) > LARGEST_PIECE:
            raise ValueError("it lists too many parts")
        return data


def zip_file(file: BinaryIO) -> ZipFile:
    """The ZIP archive in ``file``; raises `ValueError` where its list of parts is too long to be read at once."""
    return ZipFile(cast(BinaryIO, _Frugal(file)))


def require_unlinked(folder: Path, names: Iterable[str] = WRITTEN) -> None:
    """Raise `InputError` where anything in ``folder`` that the patterns ``names`` match, or below a folder that they match,
    is a link, through which a run would write elsewhere, a pipe, on which it would wait, or a device. ``folder`` itself may
    be a link, as the user named it."""
    entries = [entry for entry in _entries(str(folder)) if any(fnmatch(entry.name, name) for name in names)]
    while entries:
        entry = entries.pop()
        status = entry.stat(follow_symlinks=False)
        if stat.S_ISDIR(status.st_mode):
            entries += _entries(entry.path)
            continue
        # Logs are appended to, so that a second hard link would change too; all other files are replaced as a whole.
        second = status.st_nlink > 1 and entry.name.endswith(".log")
        if stat.S_ISREG(status.st_mode) and not second:
            continue
        wrong = "a link to another file" if stat.S_ISLNK(status.st_mode) or second else "a pipe or a device"
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
