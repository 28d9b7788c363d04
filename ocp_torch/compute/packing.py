"""Functions and what they work on, as bytes for another process of the same run."""

import io
import pickle
from typing import Any

import cloudpickle
import torch
from torch import Tensor


class Packer(cloudpickle.Pickler):
    """Packs all but what is ``shared``, of which it leaves the numbers; of dense tensors only what they show."""

    def __init__(self, file: io.BytesIO, shared: tuple[object, ...]) -> None:
        super().__init__(file)
        self.shared = {id(thing): number for number, thing in enumerate(shared)}

    def persistent_id(self, thing: object) -> int | None:
        return self.shared.get(id(thing))

    def reducer_override(self, thing: Any) -> Any:
        # PyTorch packs the whole block of memory that a tensor is a view of. A column stays a view: sums over numbers that
        # lie apart are made in another order.
        if type(thing) is Tensor and thing.layout is torch.strided:
            if thing.untyped_storage().nbytes() > thing.nbytes and (alone := thing.clone()).stride() == thing.stride():
                return alone.__reduce_ex__(pickle.DEFAULT_PROTOCOL)
        return super().reducer_override(thing)


class Unpacker(pickle.Unpickler):
    """Puts what this process has of the ``shared`` things in the place of their numbers."""

    def __init__(self, file: io.BytesIO, shared: tuple[object, ...]) -> None:
        super().__init__(file)
        self.shared = shared

    def persistent_load(self, number: int) -> object:
        return self.shared[number]


def packed(what: object, *shared: object) -> bytes:
    """``what``, with lambdas and closures; of what is ``shared``, such as a problem that may hold what cannot be sent, the
    numbers alone."""
    file = io.BytesIO()
    Packer(file, shared).dump(what)
    return file.getvalue()


def unpacked(these: bytes, *shared: object) -> Any:
    """What was `packed` by a process of this run, which is trusted, with what this one has of ``shared``."""
    return Unpacker(io.BytesIO(these), shared).load()
