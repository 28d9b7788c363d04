"""`checkpoints/last.pt`: written atomically behind a digest, read without running code from it."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path

import torch

from ocp_torch.errors import InputError
from ocp_torch.storage import write_atomically

SCHEMA = 1
# The file is one line, this word with the schema and a digest, and then what torch.save wrote.
MAGIC = "ocp_torch-checkpoint"


def save_checkpoint(path: Path, state: dict) -> None:
    """Write ``state`` (tensors, numbers, strings and containers of them) to ``path`` in one step."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    header = f"{MAGIC} {SCHEMA} {hashlib.sha256(content).hexdigest()}\n".encode()
    write_atomically(path, lambda temporary: temporary.write_bytes(header + content))


def load_checkpoint(path: Path) -> dict:
    """Read what `save_checkpoint` wrote. Raises `InputError` when it is missing, damaged or of another schema."""
    if not path.is_file():
        raise InputError(f"{path} does not exist; give the path of a checkpoint.")
    header, _, content = path.read_bytes().partition(b"\n")
    words = header.decode("ascii", errors="replace").split(" ")
    if len(words) != 3 or words[0] != MAGIC:
        raise InputError(f"{path} is not a checkpoint of ocp_torch, or its first bytes are damaged.")
    if words[1] != str(SCHEMA):
        raise InputError(f"{path} has schema {words[1]!r}, but this version of ocp_torch reads {SCHEMA}.")
    if hashlib.sha256(content).hexdigest() != words[2]:
        raise InputError(f"{path} is damaged: its contents do not match the digest it carries.")
    try:
        return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # a crafted archive raises whatever its odd part leads to
        reason = next(iter(str(error).splitlines()), "empty")
        raise InputError(f"{path} is not a readable checkpoint ({type(error).__name__}: {reason}).") from None
