"""`checkpoints/*.pt`: written atomically behind a digest, read without running code from them."""

from __future__ import annotations

import contextlib
import hashlib
import io
import math
import os
import zipfile
from pathlib import Path

import torch
from torch import Tensor

from ocp_torch.errors import InputError
from ocp_torch.storage import require_readable_size, write_atomically

SCHEMA = 2
# The file is one line, this word with the schema and a digest, and then what torch.save wrote.
MAGIC = "ocp_torch-checkpoint"
LAST, BEST = "last.pt", "best.pt"


def save_checkpoint(path: Path, state: dict, keep: int = 1) -> None:
    """Write ``state`` (tensors, numbers, strings and containers of them) to ``path`` in one step.

    With ``keep`` above 1 the file that was there becomes `last-1.pt` (for `last.pt`), that one `last-2.pt`, and so on, so
    that ``keep`` of them stay. Raises `StorageError` when it cannot be written; the files that were there stay.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    header = f"{MAGIC} {SCHEMA} {hashlib.sha256(content).hexdigest()}\n".encode()

    # Older files move only once the new one is safe: a full disk must not cost one of them.
    write_atomically(path, lambda temporary: temporary.write_bytes(header + content), lambda: _make_room(path, keep))


def older(path: Path, age: int) -> Path:
    """Where the file that was ``age`` saves ago at ``path`` is kept."""
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
    if not path.is_file():
        raise InputError(f"{path} does not exist; give the path of a checkpoint.")
    require_readable_size(path)
    try:
        header, _, content = path.read_bytes().partition(b"\n")
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from None
    words = header.decode("ascii", errors="replace").split(" ")
    if len(words) != 3 or words[0] != MAGIC:
        raise InputError(f"{path} is not a checkpoint of ocp_torch, or its first bytes are damaged.")
    if words[1] != str(SCHEMA):
        raise InputError(f"{path} has schema {words[1][:20]!r}, but this version of ocp_torch reads {SCHEMA}.")
    if hashlib.sha256(content).hexdigest() != words[2]:
        raise InputError(f"{path} is damaged: its contents do not match the digest it carries.")
    try:
        _require_stored(content)
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
        _require_plain(state)
    except Exception as error:  # a crafted archive raises whatever its odd part leads to
        reason = next(iter(str(error).splitlines()), "empty").rstrip(".")
        raise InputError(f"{path} is not a readable checkpoint ({type(error).__name__}: {reason}).") from None
    return state


def newest(folder: Path) -> tuple[dict, Path, list[str]]:
    """The newest good checkpoint of ``folder``, where it lies, and a sentence on each newer one that is not good.

    Raises `InputError` when none is.
    """
    ages = sorted(folder.glob("last*.pt"), key=_age)
    refused: list[str] = []
    for path in [*ages, folder / BEST]:
        try:
            return load_checkpoint(path), path, refused
        except InputError as error:
            if path.exists():
                refused.append(str(error))
    if refused:
        raise InputError(f"{folder} holds no good checkpoint: {' '.join(refused)}")
    raise InputError(f"{folder} holds no checkpoint, so there is nothing to go on from.")


def _age(path: Path) -> int:
    suffix = path.stem.removeprefix("last").removeprefix("-")
    return int(suffix) if suffix.isdecimal() else 0


def _require_stored(content: bytes) -> None:
    """A crafted archive could unpack to any size; `torch.save` never compresses."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = archive.infolist()
    if any(e.compress_type != zipfile.ZIP_STORED for e in entries) or sum(e.file_size for e in entries) > len(content):
        raise ValueError("its parts are compressed")


def _require_plain(state: object) -> None:
    """Every tensor holds as many numbers as it claims: none is a small storage seen as a huge one."""
    if isinstance(state, Tensor):
        claimed = math.prod(state.shape) * state.element_size()
        if state.layout != torch.strided or claimed > state.untyped_storage().nbytes():
            raise ValueError(f"a tensor of shape {tuple(state.shape)} is not all there")
    elif isinstance(state, dict):
        for value in state.values():
            _require_plain(value)
    elif isinstance(state, list | tuple):
        for value in state:
            _require_plain(value)
