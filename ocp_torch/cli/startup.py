"""A command begins sooner without the parts of PyTorch that it never uses."""

from __future__ import annotations

import sys
from typing import Any

from torch.optim import Optimizer

# The first optimiser of a process imports PyTorch's compiler, to tell it to leave these methods alone: 1.3 s of CPU.
LEFT_ALONE = ("add_param_group", "state_dict", "load_state_dict", "zero_grad")
# `pytorch_optimizer` does without tensors that are spread over machines where it finds none: 0.5 s of CPU.
DISTRIBUTED = ("torch.distributed.tensor", "torch.distributed._tensor")


def spare_imports() -> None:
    """Spare this process PyTorch's compiler, until somebody compiles, and distributed tensors in the optimisers.

    For the process of a command only: in somebody else's program both may be wanted. Where PyTorch is made differently
    nothing happens, and the process starts as slowly as any other.
    """
    for name in LEFT_ALONE:
        method = getattr(getattr(Optimizer, name, None), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dynamo_disable = method  # what `torch._disable_dynamo` looks for before it imports the compiler
    hidden = [name for name in DISTRIBUTED if name not in sys.modules]
    modules: dict[str, Any] = sys.modules
    modules.update(dict.fromkeys(hidden))  # an import of what is None there fails
    try:
        import pytorch_optimizer  # noqa: F401
    finally:
        for name in hidden:
            del sys.modules[name]
