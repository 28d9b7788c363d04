"""What a computation asks of the numbers it computes with, and the constants it makes: noted, to run it again without either.

A CUDA graph runs operators alone: no number can be looked at on the way, and nothing be brought from the host. So a function
that is to be captured is called once while both are noted (`DecisionRecorder`), and captured while it is told what was noted
(`DecisionReplayer`).
"""

import contextvars
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

# Functions that make a tensor of Python's numbers.
MAKERS = {torch.tensor, torch.as_tensor, Tensor.new_tensor}


def decided(asked: Tensor) -> int:
    """``int(asked)`` of a whole number or flag ``()``, on which the course of a function depends."""
    listener = _listener.get()
    return int(asked) if listener is None else listener.answer(asked)


class DecisionRecorder(TorchFunctionMode):
    """A context within which answers and constants are noted, in their order."""

    def __init__(self) -> None:
        super().__init__()
        self.answers: list[int] = []
        self.constants: list[Tensor] = []

    def answer(self, asked: Tensor) -> int:
        self.answers.append(int(asked))
        return self.answers[-1]

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        if _makes(func, args) or func is Tensor.to and args[0].device != found.device:
            self.constants.append(found.clone())
        return found


class DecisionReplayer(TorchFunctionMode):
    """A context within which answers and constants are those that were ``noted``; ``questions`` are kept, to be checked."""

    def __init__(self, noted: DecisionRecorder) -> None:
        super().__init__()
        self.answers, self.constants = iter(noted.answers), iter(noted.constants)
        self.questions: list[Tensor] = []

    def answer(self, asked: Tensor) -> int:
        self.questions.append(asked.long())
        return next(self.answers)

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if _makes(func, args) or func is Tensor.to and args[0].is_cpu and _leaves_cpu(args[1:], kwargs):
            return next(self.constants).clone()  # the function may change it
        return func(*args, **(kwargs or {}))


_listener: contextvars.ContextVar[DecisionRecorder | DecisionReplayer | None] = contextvars.ContextVar(
    "listener", default=None
)


@contextmanager
def listening(listener: Any) -> Iterator[None]:
    """Within it what `decided` is asked, and what constants are made, goes to ``listener``."""
    token = _listener.set(listener)
    try:
        with listener:
            yield
    finally:
        _listener.reset(token)


def _makes(func: Any, args: Any) -> bool:
    """Whether ``func`` makes a tensor of Python's numbers."""
    data = args[1:2] if func is Tensor.new_tensor else args[:1]
    return func in MAKERS and len(data) == 1 and not isinstance(data[0], Tensor)


def _leaves_cpu(args: Any, kwargs: Any) -> bool:
    """Whether `Tensor.to` with these arguments leads to another device than the CPU."""
    given = [*args, *(kwargs or {}).values()]
    devices = [a.device if isinstance(a, Tensor) else a for a in given if isinstance(a, Tensor | torch.device | str)]
    return any(torch.device(d).type != "cpu" for d in devices)
