"""Untrusted NumPy files, `.npy` and `.npz`: the size that an array claims is checked before its numbers are read."""

import io
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np

from ocp_torch.errors import InputError, first_line, nearest, visible
from ocp_torch.files.reading import opened, zip_file

# Bytes of the header of an array of numbers at most; NumPy itself writes 118.
LONGEST_HEADER = 1024
# NumPy's letters for kinds of numbers: floats and integers, and flags.
REAL = "fiu"
FLAGS = "b"
# Any file may unpack to this many bytes.
FREELY = 2**27
# A file may unpack to more, up to this many times its own size: of a recording at least one part in `3 + m`, the random
# states, hardly compresses.
MOST_TIMES = 64


@dataclass(frozen=True)
class Form:
    """Shape and size of an array, as its header claims."""

    shape: tuple[int, ...]
    size: int  # bytes in memory, as it comes or as float64, whichever is more
    stored: int  # bytes of header and numbers in the file


def form_of(file: BinaryIO, kinds: str = REAL) -> Form:
    """The form of the array at the start of ``file``; `ValueError` where there is none, or it is not of ``kinds``."""
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
    except Exception:  # NumPy's parser raises many types
        raise ValueError("is damaged: its header is not one of NumPy's") from None
    if dtype.hasobject:
        raise ValueError("holds Python objects, which are never read from a file")
    if dtype.kind not in kinds or min(shape, default=0) < 0:
        raise ValueError(f"has type {dtype}, but must hold real numbers")
    count = math.prod(map(int, shape))
    return Form(tuple(map(int, shape)), count * max(dtype.itemsize, 8), header.tell() + count * dtype.itemsize)


def _numbers(file) -> np.ndarray:
    """The array in ``file``, whose form has been checked, in float64."""
    array = np.lib.format.read_array(file, allow_pickle=False, max_header_size=LONGEST_HEADER)
    return array.astype(np.float64, copy=False)


def read_npy(path: Path, most: int) -> np.ndarray:
    """The array in the file ``path``, in float64. Raises `InputError` where the file cannot be read, and `ValueError`, whose
    message follows the file's name, where it holds no array of numbers or one of more than ``most`` bytes."""
    with opened(path) as file:
        form = form_of(file, REAL + FLAGS)
        if form.size > most:
            raise ValueError(f"has shape {form.shape}, which is too large")
        file.seek(0)
        return _numbers(file)


def read_npz(path: Path, known: Collection[str], most: int) -> dict[str, np.ndarray]:
    """The arrays of the file ``path`` by name, in float64. Raises `InputError` where a name is not among the ``known`` ones,
    where the file or all its arrays together have more than ``most`` bytes, and for any damage."""
    with opened(path, most) as file:
        try:
            with zip_file(file) as archive:
                forms = _forms(path, archive, known)
                total, size = sum(form.size for form in forms.values()), file.seek(0, io.SEEK_END)
                limit = min(most, max(FREELY, MOST_TIMES * size))
                if total > limit:
                    raise InputError(
                        f"{path} unpacks to {total:,} bytes; at most {limit:,} are read from one of its size."
                    )
                return {name: _numbers(archive.open(f"{name}.npy")) for name in forms}
        except InputError:
            raise
        except Exception as error:  # zipfile, zlib and NumPy have no one type for damage
            raise InputError(
                f"{path} is not a whole .npz file: it is damaged or of another kind ({first_line(error)})."
            ) from None


def _forms(path: Path, archive: ZipFile, known: Collection[str]) -> dict[str, Form]:
    """The form of each array of the ``archive``, by its name. Raises `InputError`."""
    forms: dict[str, Form] = {}
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        if name not in known or name in forms:
            hint = nearest(name, known)
            raise InputError(f"{path} holds {visible(name, 80)!r}, which is no array of a recording{hint}.")
        if entry.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
            raise InputError(f"{path}: {name} is packed in a way that NumPy does not use.")
        try:
            with archive.open(entry) as stream:
                form = form_of(cast(BinaryIO, stream))
        except ValueError as error:
            raise InputError(f"{path}: {name} {error}.") from None
        if form.stored != entry.file_size:
            claimed = f"{name} claims to have {form.stored:,} bytes"
            raise InputError(f"{path} is damaged: {claimed}, but has {entry.file_size:,}.")
        forms[name] = form
    return forms
