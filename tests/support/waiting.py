"""What a step may not do where it is to be captured: wait for the device, or bring numbers from the host."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

# They read a number, give a shape that depends on numbers, or make a tensor of Python's numbers.
FORBIDDEN = {"_local_scalar_dense", "equal", "is_nonzero", "lift_fresh", "masked_select", "nonzero"}


class Waits(TorchDispatchMode):
    """Notes the names of operators that do."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.split("::")[1]
        chosen = args[1] if name.startswith("index") and isinstance(args[1], list | tuple) else ()
        if name in FORBIDDEN or any(isinstance(i, Tensor) and i.dtype == torch.bool for i in chosen):
            self.seen.add(name)
        return func(*args, **(kwargs or {}))
