"""`checkpoints/*.pt`: written atomically behind a digest, read without running code from them."""

import contextlib
import hashlib
import io
import os
import pickle
from pathlib import Path

import torch

from ocp_torch.errors import InputError, StorageError, first_line
from ocp_torch.files.archive import After, unpacked
from ocp_torch.files.reading import LARGEST_FILE, kind, opened
from ocp_torch.files.storage import write_atomically

SCHEMA = 2
# A file begins with one line: this word, the schema and a digest of the rest, which torch.save wrote.
MAGIC = "ocp_torch-checkpoint"
LAST, BEST = "last.pt", "best.pt"
LONGEST_HEADER = 256  # bytes of that line at most
READ_AT_ONCE = 2**22  # bytes, for the digest


def save_checkpoint(path: Path, state: dict, keep: int = 1) -> None:
    """Write ``state`` (tensors, numbers, strings and containers of them) to ``path`` in one step.

    With ``keep`` above 1 the file that was there becomes `last-1.pt` (for `last.pt`), that one `last-2.pt`, and so on, so
    that ``keep`` of them stay. Raises `StorageError` when it cannot be written; the files that were there stay.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    if len(content) + LONGEST_HEADER > LARGEST_FILE:
        raise StorageError(f"{path} would have {len(content):,} bytes, but none above {LARGEST_FILE:,} is read back.")
    header = f"{MAGIC} {SCHEMA} {hashlib.sha256(content).hexdigest()}\n".encode()
    # Older files move only once the new one is safe: a full disk must not cost one of them.
    write_atomically(path, lambda temporary: temporary.write_bytes(header + content), lambda: _make_room(path, keep))


def older(path: Path, age: int) -> Path:
    """The path of the file that was at ``path`` ``age`` saves ago."""
    return path.with_stem(f"{path.stem}-{age}") if age else path


def _make_room(path: Path, keep: int) -> None:
    """Shift the older files by one; ``path`` itself is linked, so that it is never missing."""
    for age in range(keep - 1, 1, -1):
        with contextlib.suppress(FileNotFoundError):
            os.replace(older(path, age - 1), older(path, age))
    if keep > 1 and path.exists():
        older(path, 1).unlink(missing_ok=True)
        try:
            os.link(path, older(path, 1))
        except OSError:  # a file system without links
            os.replace(path, older(path, 1))


def load_checkpoint(path: Path) -> dict:
    """Read what `save_checkpoint` wrote. Raises `InputError` when it is missing, damaged or of another schema."""
    if kind(path) is None:
        raise InputError(f"{path} does not exist; give the path of a checkpoint.")
    with opened(path) as file:
        header = file.readline(LONGEST_HEADER)
        words = header.decode("ascii", errors="replace").rstrip("\n").split(" ")
        if len(words) != 3 or words[0] != MAGIC or not header.endswith(b"\n"):
            raise InputError(f"{path} is not a checkpoint of ocp_torch, or its first bytes are damaged.")
        if words[1] != str(SCHEMA):
            raise InputError(f"{path} has schema {words[1][:20]!r}, but this version of ocp_torch reads {SCHEMA}.")
        sha = hashlib.sha256()
        while piece := file.read(READ_AT_ONCE):
            sha.update(piece)
        if sha.hexdigest() != words[2]:
            raise InputError(f"{path} is damaged: its contents do not match the digest it carries.")
        try:
            return unpacked(After(file, len(header)))
        except pickle.UnpicklingError:  # PyTorch's own words tell how to run what the file holds
            raise InputError(
                f"{path} is not a readable checkpoint: it holds more than numbers, words and tensors, which is never run."
            ) from None
        except Exception as error:  # a crafted archive raises whatever its odd part leads to
            reason = f"{type(error).__name__}: {first_line(error)}"
            raise InputError(f"{path} is not a readable checkpoint ({reason}).") from None


def newest(folder: Path) -> tuple[dict, Path, list[str]]:
    """The newest good checkpoint of ``folder``, its path, and a sentence on each newer one that is damaged.

    Raises `InputError` when there is no good one.
    """
    refused: list[str] = []
    for path in [*sorted(folder.glob("last*.pt"), key=_age), folder / BEST]:
        try:
            return load_checkpoint(path), path, refused
        except InputError as error:
            if path.exists():
                refused.append(str(error))
    if refused:
        raise InputError(f"{folder} holds no good checkpoint: {' '.join(refused)}")
    raise InputError(f"{folder} holds no checkpoint, so there is nothing to go on from.")


def misfit(path: Path, error: Exception) -> InputError:
    """What to tell of an ``error`` that the state in ``path`` raised in a run that was to go on from it."""
    return InputError(f"{path} does not fit this run ({type(error).__name__}: {first_line(error)}).")


def _age(path: Path) -> int:
    suffix = path.stem.removeprefix("last-")
    return int(suffix) if suffix.isdecimal() else 0
