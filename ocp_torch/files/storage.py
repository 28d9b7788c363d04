"""Files that survive a crash: written whole or not at all; and safetensors files with JSON metadata and a digest."""

import contextlib
import fcntl
import hashlib
import json
import math
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ocp_torch.errors import InputError, StorageError
from ocp_torch.files.plain import NotPlain, json_object
from ocp_torch.files.reading import LARGEST_FILE, kind, opened

# Keys of the header of our safetensors files: the metadata as JSON, and a digest of metadata and tensors.
METADATA_KEY = "ocp_torch"
DIGEST_KEY = "sha256"
# Bytes of the header of a safetensors file, at most: more than any controller or recording has.
LARGEST_HEADER = 2**24
# Tensors in such a file, at most.
MOST_TENSORS = 2**14
# Suffix of temporary files.
PART = ".part"
# The user's umask. Reading it means setting it for a moment, so it is done here, before there are threads.
os.umask(_UMASK := os.umask(0o077))


def write_atomically(path: Path, write: Callable[[Path], object], make_room: Callable[[], None] | None = None) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then rename it to ``path`` in one step that survives a crash.

    ``make_room`` is called in between, once the new file is whole and on the disk. Raises `StorageError` when there is no
    room or no permission; the old file is then untouched.
    """
    temporary = None
    if os.path.lexists(path) and not path.is_file():
        raise StorageError(f"{path} is no file but a folder or a device, which nothing may replace.")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", suffix=PART, delete=False) as file:
            temporary = Path(file.name)
        write(temporary)
        sync(temporary)
        temporary.chmod(0o666 & ~_UMASK)
        if make_room is not None:
            make_room()
        os.replace(temporary, path)
        sync(path.parent)
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise StorageError(f"{path} cannot be written: {reason}; what was saved before is untouched.") from None
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()


def sync(path: Path) -> None:
    """Force the contents of a file, or the names in a folder, onto the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sweep_temporaries(folder: Path) -> None:
    """Remove the temporary files in ``folder`` of processes that were killed in `write_atomically`."""
    for leftover in folder.glob(f".*{PART}"):
        if re.fullmatch(r"\..+\.[a-z0-9_]{8}", leftover.name.removesuffix(PART)):
            with contextlib.suppress(OSError):
                leftover.unlink()


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Raises `InputError` while somebody else is within this for the same ``folder``; who was killed is not. On a file system
    without locks nothing is refused."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{folder} is being written to by another process; stop that, or wait for its end."
            ) from None
        except OSError:
            pass
        yield
    finally:
        os.close(handle)


def finite(data):
    """``data`` with infinities and NaN, which JSON does not have, as the words inf, -inf and nan."""
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
        sha.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return sha.hexdigest()


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict) -> None:
    """Write ``tensors`` and ``metadata``, as JSON, to the safetensors file ``path``, with a digest of both."""
    text = json.dumps(finite(metadata), allow_nan=False)
    tensors = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    header = {METADATA_KEY: text, DIGEST_KEY: digest(tensors, text)}
    write_atomically(path, lambda temporary: save_file(tensors, str(temporary), metadata=header))


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict]:
    """The tensors and the metadata that `save_tensors` wrote. Raises `InputError` for any other file or a damaged one."""
    if kind(path) is None:
        raise InputError(f"{path} does not exist; give the path of a controller.safetensors file.")
    tensors, header = read_safetensors(path)
    if METADATA_KEY not in header or DIGEST_KEY not in header:
        raise InputError(f"{path} is a safetensors file, but was not written by ocp_torch.")
    if digest(tensors, header[METADATA_KEY]) != header[DIGEST_KEY]:
        raise InputError(f"{path} is damaged: its contents do not match the digest it carries.")
    try:
        return tensors, json_object(header[METADATA_KEY])
    except NotPlain as error:
        raise InputError(f"{path} is damaged: in its metadata, {error}.") from None


def read_safetensors(path: Path, most: int = LARGEST_FILE) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the header of a safetensors file of at most ``most`` bytes. Raises `InputError` for any other file."""
    with opened(path, most) as file:
        length = int.from_bytes(file.read(8), "little")
    if length > LARGEST_HEADER:
        raise InputError(f"{path} is not a readable safetensors file: its header claims to have {length:,} bytes.")
    try:
        with safe_open(str(path), framework="pt", device="cpu") as file:
            names = list(file.keys())
            if len(names) > MOST_TENSORS:
                raise InputError(f"{path} holds {len(names):,} tensors, but at most {MOST_TENSORS:,} are read.")
            return {name: file.get_tensor(name) for name in names}, file.metadata() or {}
    except InputError:
        raise
    except Exception as error:  # the library has no one type for damage
        told = f"{path} is not a readable safetensors file ({' '.join(str(error).split()).rstrip('.')})"
        raise InputError(f"{told}; it is damaged or of another kind.") from None
