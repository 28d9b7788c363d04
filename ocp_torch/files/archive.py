"""Archives of `torch.save`, maybe forged: checked before and after they are unpacked."""

import math
import os
import pickle
import pickletools
import re
import zipfile
from typing import Any, BinaryIO, cast

import torch

from ocp_torch.files.plain import require_plain
from ocp_torch.files.reading import zip_file

# An archive lists its contents as a pickle: bytes of that list, at most, a thousand times those of a run's.
LARGEST_LIST = 2**22
# Instructions of that list, at most, a thousand times those of a run's.
MOST_INSTRUCTIONS = 2**20
# Globals that the list may name. PyTorch's own choice also has functions that allocate memory.
MADE_OF = re.compile(r"collections (OrderedDict|Counter)|torch \w+Storage|torch\._utils _rebuild_(tensor_v2|parameter)")
# All tensors together may have this many times as many bytes as the file: several may share the same numbers.
SHARED = 4


class After:
    """The rest of an open file after its first ``start`` bytes, as a file of its own that is never in memory as a whole."""

    def __init__(self, file: BinaryIO, start: int) -> None:
        self.file, self.start = file, start
        self.size = file.seek(0, os.SEEK_END) - start
        self.read, self.readinto = file.read, file.readinto  # type: ignore[attr-defined] # binary files have both
        self.seek(0)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        return self.file.seek(offset + self.start if whence == os.SEEK_SET else offset, whence) - self.start

    def tell(self) -> int:
        return self.file.tell() - self.start

    def seekable(self) -> bool:
        return True


def unpacked(content: After) -> Any:
    """Plain data with tensors, as `torch.save` wrote them; no code from the archive runs. Raises `pickle.UnpicklingError`
    where it holds anything else, `ValueError` where that is too large or not what it claims to be, and what PyTorch raises
    where it is damaged."""
    _require_modest(content)
    state = torch.load(cast(BinaryIO, content), map_location="cpu", weights_only=True)
    claimed = 0
    for tensor in require_plain(state, tensors=True):
        shape = tuple(tensor.shape)
        if tensor.layout != torch.strided or tensor.device.type != "cpu" or tensor.is_quantized or tensor.is_complex():
            raise ValueError(f"a tensor of shape {shape} is of no kind that a run has")
        own = math.prod(shape) * tensor.element_size()
        if own > tensor.untyped_storage().nbytes():  # a few numbers, repeated to look like a huge tensor
            raise ValueError(f"a tensor of shape {shape} is not all there")
        claimed += own
    if claimed > SHARED * content.size:
        raise ValueError("its tensors are one and the same many times over")
    return state


def _require_modest(content: After) -> None:
    """Raise unless the archive unpacks to no more than its own size, and its list is short and names only `MADE_OF`."""
    with zip_file(cast(BinaryIO, content)) as archive:
        entries = archive.infolist()
        stored = all(e.compress_type == zipfile.ZIP_STORED for e in entries)  # `torch.save` never compresses
        if not stored or sum(e.file_size for e in entries) > content.size:
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
