"""The archive that `torch.save` makes, from strangers: judged before anything in it is unpacked, and again once it is."""

from __future__ import annotations

import math
import os
import pickle
import pickletools
import re
import zipfile
from collections.abc import Iterator
from typing import Any, BinaryIO, cast

import torch
from torch import Tensor

from ocp_torch.files.plain import require_plain
from ocp_torch.files.reading import zip_file

# Of the list of an archive's parts: bytes and instructions at most; a thousand times what a run's has.
LARGEST_LIST, MOST_INSTRUCTIONS = 2**22, 2**20
# What a run's states are made of, besides numbers, words and containers. PyTorch's own list has functions that allocate.
MADE_OF = re.compile(r"collections (OrderedDict|Counter)|torch \w+Storage|torch\._utils _rebuild_(tensor_v2|parameter)")
# How often the same number may be seen by tensors.
SHARED = 4


class After:
    """What follows the first ``start`` bytes of an open file, as a file of its own: only what is asked for is in memory."""

    def __init__(self, file: BinaryIO, start: int) -> None:
        self.file, self.start = file, start
        self.size = file.seek(0, os.SEEK_END) - start
        self.seek(0)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self.file.seek(offset + self.start if whence == os.SEEK_SET else offset, whence) - self.start

    def tell(self) -> int:
        return self.file.tell() - self.start

    def read(self, count: int = -1) -> bytes:
        return self.file.read(count)

    def readinto(self, buffer) -> int:
        return self.file.readinto(buffer)  # type: ignore[attr-defined] # binary files have it

    def seekable(self) -> bool:
        return True


def unpacked(content: After) -> Any:
    """Plain data with tensors, as `torch.save` wrote them. Raises `pickle.UnpicklingError` where there is anything else in
    it, which is not run, `ValueError` where it is crafted, and whatever PyTorch raises where it is damaged."""
    _require_modest(content)
    state = torch.load(cast(BinaryIO, content), map_location="cpu", weights_only=True)
    require_plain(state, tensors=True)
    _require_whole(state, content.size)
    return state


def _require_modest(content: After) -> None:
    """A crafted archive could unpack to any size; `torch.save` never compresses. And its list of parts makes few things."""
    with zip_file(cast(BinaryIO, content)) as archive:
        entries = archive.infolist()
        if (
            any(e.compress_type != zipfile.ZIP_STORED for e in entries)
            or sum(e.file_size for e in entries) > content.size
        ):
            raise ValueError("its parts are compressed")
        for entry in entries:
            if entry.filename.lower().endswith(".pkl"):
                if entry.file_size > LARGEST_LIST:
                    raise ValueError("the list of its parts is too long")
                _require_few_things(archive.read(entry))
    content.seek(0)


def _require_few_things(listed: bytes) -> None:
    for count, (instruction, argument, _) in enumerate(pickletools.genops(listed)):
        if count > MOST_INSTRUCTIONS:
            raise ValueError("the list of its parts is too long")
        name = instruction.name
        if name in ("STACK_GLOBAL", "INST", "OBJ") or (name == "GLOBAL" and not MADE_OF.fullmatch(str(argument))):
            raise pickle.UnpicklingError


def _require_whole(state: object, size: int) -> None:
    """Every tensor of a plain ``state`` holds as many numbers as it claims, none a small storage seen as a huge one; all of
    them together are hardly more than the ``size`` bytes of the file; and they are real."""
    claimed = 0
    for tensor in _tensors(state):
        own = math.prod(tensor.shape) * tensor.element_size()
        if tensor.layout != torch.strided or tensor.device.type != "cpu" or tensor.is_quantized or tensor.is_complex():
            raise ValueError(f"a tensor of shape {tuple(tensor.shape)} is of no kind that a run has")
        if own > tensor.untyped_storage().nbytes():
            raise ValueError(f"a tensor of shape {tuple(tensor.shape)} is not all there")
        claimed += own
    if claimed > SHARED * size:
        raise ValueError("its tensors are one and the same many times over")


def _tensors(state: object) -> Iterator[Tensor]:
    if isinstance(state, Tensor):
        yield state
    elif isinstance(state, dict | list | tuple):
        for value in state.values() if isinstance(state, dict) else state:
            yield from _tensors(value)
