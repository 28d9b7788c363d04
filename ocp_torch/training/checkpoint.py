"""`checkpoints/last.pt`: written atomically, read without running code from it."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch

from ocp_torch.errors import InputError
from ocp_torch.storage import write_atomically

SCHEMA = 1


def save_checkpoint(path: Path, state: dict) -> None:
    """Write ``state`` (tensors, numbers, strings and containers of them) to ``path`` in one step."""
    write_atomically(path, lambda temporary: torch.save({"schema": SCHEMA, "state": state}, temporary))


def load_checkpoint(path: Path) -> dict:
    """Read what `save_checkpoint` wrote. Raises `InputError` when it is missing, damaged or of a newer schema."""
    if not path.is_file():
        raise InputError(f"{path} does not exist; give the path of a checkpoint.")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, OSError, ValueError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path} is not a readable checkpoint ({type(error).__name__}: {reason}).") from None
    if not isinstance(saved, dict) or saved.get("schema") != SCHEMA:
        raise InputError(f"{path} is not a checkpoint of schema {SCHEMA}.")
    return saved["state"]
