"""NumPy's files, `.npy` and `.npz`, from strangers: what an array claims to be is judged before a byte of it is unpacked."""

from __future__ import annotations

import io
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ocp_torch.errors import InputError, nearest, visible
from ocp_torch.files.reading import opened, zip_file

# Bytes of the header of an array of numbers at most; NumPy itself writes 118.
LONGEST_HEADER = 1024
# NumPy's letters for the kinds of numbers that are read.
REAL, FLAGS = "fiu", "b"
# What is unpacked from any file, in bytes, and how often its own size from a larger one. Random states hardly compress,
# and are a part of one in `3 + m` of a recording; the others may be constant.
FREELY, MOST_TIMES = 2**27, 64


@dataclass(frozen=True)
class Form:
    """What an array claims to be."""

    shape: tuple[int, ...]
    dtype: np.dtype
    start: int  # where its numbers begin

    @property
    def size(self) -> int:
        """Bytes in memory, as it comes and as float64, whichever is more."""
        return math.prod(self.shape) * max(self.dtype.itemsize, 8)

    @property
    def stored(self) -> int:
        """Bytes of header and numbers in the file."""
        return self.start + math.prod(self.shape) * self.dtype.itemsize


def form_of(file: BinaryIO, kinds: str = REAL) -> Form:
    """The form of the array that begins in ``file``; `ValueError` where it is none, or not of the ``kinds`` of numbers."""
    begin = file.read(8)
    if len(begin) < 8 or begin[:6] != b"\x93NUMPY" or begin[6] not in (1, 2):
        raise ValueError("is damaged: it is no array of NumPy's")
    begin += file.read(2 if begin[6] == 1 else 4)
    length = int.from_bytes(begin[8:], "little")
    if length > LONGEST_HEADER:
        raise ValueError(f"is damaged: its header claims to have {length:,} bytes")
    header = io.BytesIO(begin + file.read(length))
    version = np.lib.format.read_magic(header)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        shape, _, dtype = read(header, max_header_size=LONGEST_HEADER)
    except Exception:  # the parser beneath has types of its own
        raise ValueError("is damaged: its header is not one of NumPy's") from None
    if dtype.hasobject:
        raise ValueError("holds Python objects, which are never read from a file")
    if dtype.kind not in kinds or min(shape, default=0) < 0:
        raise ValueError(f"has type {dtype}, but must hold real numbers")
    return Form(tuple(map(int, shape)), dtype, header.tell())


def read_npy(path: Path, most: int) -> np.ndarray:
    """The array in the file ``path``, in float64 and of at most ``most`` bytes; `InputError` for a file that cannot be read,
    and `ValueError` for a larger array or none."""
    with opened(path) as file:
        form = form_of(file, REAL + FLAGS)
        if form.size > most:
            raise ValueError(f"has shape {form.shape}, which is too large")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False, max_header_size=LONGEST_HEADER).astype(np.float64)


def read_npz(path: Path, known: Collection[str], most: int) -> dict[str, np.ndarray]:
    """The arrays of the file ``path``, in float64: their names among the ``known`` ones, all together of at most ``most``
    bytes. Raises `InputError`, in one sentence, for anything else."""
    with opened(path, most) as file:
        try:
            with zip_file(file) as archive:
                forms: dict[str, Form] = {}
                for entry in archive.infolist():
                    name = entry.filename.removesuffix(".npy")
                    if name not in known or name in forms:
                        hint = nearest(name, known)
                        raise InputError(f"{path} holds {visible(name, 80)!r}, which is no array of a recording{hint}.")
                    forms[name] = _form(path, name, archive, entry)
                total, size = sum(form.size for form in forms.values()), file.seek(0, io.SEEK_END)
                limit = min(most, max(FREELY, MOST_TIMES * size))
                if total > limit:
                    raise InputError(
                        f"{path} unpacks to {total:,} bytes; at most {limit:,} are read from one of its size."
                    )
                return {name: _numbers(archive, f"{name}.npy") for name in forms}
        except InputError:
            raise
        except Exception as error:  # zipfile, zlib and numpy have no one type for damage
            reason = next(iter(str(error).splitlines()), "").rstrip(".") or "no message"
            raise InputError(f"{path} is not a whole .npz file: it is damaged or of another kind ({reason}).") from None


def _form(path: Path, name: str, archive, entry) -> Form:
    if entry.compress_type not in (0, 8):  # stored or deflated, as NumPy writes them
        raise InputError(f"{path}: {name} is packed in a way that NumPy does not use.")
    try:
        with archive.open(entry) as stream:
            form = form_of(stream)
    except ValueError as error:
        raise InputError(f"{path}: {name} {error}.") from None
    if form.stored != entry.file_size:
        raise InputError(
            f"{path} is damaged: {name} claims to have {form.stored:,} bytes, but has {entry.file_size:,}."
        )
    return form


def _numbers(archive, name: str) -> np.ndarray:
    with archive.open(name) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False, max_header_size=LONGEST_HEADER)
    return array.astype(np.float64, copy=False)
