"""Files that survive: atomic writes, and one safetensors file with JSON metadata and a digest over everything in it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ocp_torch.errors import InputError

METADATA_KEY, DIGEST_KEY = "ocp_torch", "sha256"


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then put it in place in one step: old or new, never half."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


def finite(data):
    """``data`` with infinities and NaN, which JSON cannot hold, as the words inf, -inf and nan."""
    if isinstance(data, dict):
        return {key: finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [finite(value) for value in data]
    return str(data) if isinstance(data, float) and not math.isfinite(data) else data


def digest(tensors: dict[str, Tensor], metadata: str) -> str:
    """SHA-256 over names, types, shapes and bytes of ``tensors`` and over ``metadata``."""
    sha = hashlib.sha256(metadata.encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        sha.update(f"{name}:{tensor.dtype}:{tuple(tensor.shape)};".encode())
        sha.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return sha.hexdigest()


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict) -> None:
    """Write ``tensors`` and JSON ``metadata`` to ``path`` atomically, with their digest."""
    text = json.dumps(finite(metadata), allow_nan=False)
    tensors = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    header = {METADATA_KEY: text, DIGEST_KEY: digest(tensors, text)}
    write_atomically(path, lambda temporary: save_file(tensors, str(temporary), metadata=header))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict]:
    """Read what `save_tensors` wrote; runs no code from the file.

    Raises `InputError` when the file is missing, is not a safetensors file of ours, or does not match its digest.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist; give the path of a controller.safetensors file.")
    try:
        with safe_open(str(path), framework="pt", device="cpu") as file:
            header = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError, RuntimeError, ValueError, MemoryError) as error:
        raise InputError(
            f"{path} is not a readable safetensors file ({error}); it is damaged or of another kind."
        ) from None
    if METADATA_KEY not in header or DIGEST_KEY not in header:
        raise InputError(f"{path} is a safetensors file, but was not written by ocp_torch.")
    if digest(tensors, header[METADATA_KEY]) != header[DIGEST_KEY]:
        raise InputError(f"{path} is damaged: its contents do not match the digest it carries.")
    try:
        metadata = json.loads(header[METADATA_KEY])
    except (ValueError, RecursionError):
        raise InputError(f"{path} is damaged: its metadata is not JSON.") from None
    if not isinstance(metadata, dict):
        raise InputError(f"{path} is damaged: its metadata is not a JSON object.")
    return tensors, metadata
