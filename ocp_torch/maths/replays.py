"""Functions of tensors that are called again and again, on a GPU from a CUDA graph: a step of small networks is hundreds of
kernels, each of which takes longer to be started than to run, and a graph starts them at once.

A captured function runs as it did when it was captured. What it reads beside its tensors must stay where it is in memory, or
be a constant; it draws no random numbers and never waits for the device. Where the course of a computation depends on
numbers, it asks `decided`, and each replay checks that it would be answered the same. Tensors that it makes of Python's
numbers, or brings from the host, are those of the call before.
"""

import contextvars
import logging
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

log = logging.getLogger(__name__)

Columns = Sequence[Tensor | None]
Function = Callable[..., Columns]

# Calls before a function is captured: what it makes once is then there, and so are the answers it was given.
CALLS_FIRST = 2
# Captures after which a function whose course keeps changing is called as it is.
MOST_CAPTURES = 3
# They make a tensor of numbers of Python's.
MAKERS = {torch.tensor, torch.as_tensor, Tensor.new_tensor}
# A replay and a call differ by rounding at most. In float32, relative to the largest entry.
ROUNDING = 1e-3


class Called:
    """Calls functions as they are."""

    captures = False

    def __call__(self, key: Hashable, function: Function, inputs: Columns, pure: bool = True) -> list[Tensor | None]:
        """``function(*inputs)``, a list of tensors. ``key`` says which function it is: with an equal key and inputs of equal
        forms it must do the same. One that is not ``pure`` changes what it reads."""
        return list(function(*inputs))

    def number(self, value: float, like: Tensor) -> Any:
        """``value``, which changes from call to call, as an input."""
        return value

    def fresh(self) -> "Called":
        """Another of its kind."""
        return self

    def forget(self) -> None:
        """Let go of what was captured, as what it reads has been replaced."""


class Replays(Called):
    """Captures functions at their third call. Inputs are copied to where the capture found them, unless they are there; what
    is returned stays in place, and is overwritten by the next call. A function that cannot be captured is called."""

    captures = True

    def __init__(self, recorder: "Recorder | None" = None) -> None:
        self.recorder = recorder or CudaRecorder()
        self._functions: dict[Hashable, _Replayed] = {}

    def __call__(self, key: Hashable, function: Function, inputs: Columns, pure: bool = True) -> list[Tensor | None]:
        whole = (key, tuple(None if t is None else (t.shape, t.stride(), t.dtype, t.device) for t in inputs))
        return self._functions.setdefault(whole, _Replayed(key, self.recorder))(function, inputs, pure)

    def number(self, value: float, like: Tensor) -> Tensor:
        return torch.full((), value, dtype=like.dtype, device=like.device)

    def fresh(self) -> "Replays":
        return Replays(self.recorder)

    def forget(self) -> None:
        self._functions.clear()


def replays_on(device: torch.device) -> Called:
    """What there is for ``device``: graphs are of GPUs."""
    return Replays() if device.type == "cuda" else Called()


class _Replayed:
    """One function of inputs of one form."""

    def __init__(self, key: Hashable, recorder: "Recorder") -> None:
        self.key, self.recorder = key, recorder
        self.calls = self.captures = 0
        self.replay: Callable[[], list[Tensor | None]] | None = None

    def __call__(self, function: Function, inputs: Columns, pure: bool) -> list[Tensor | None]:
        self.calls += 1
        if self.replay is None:
            if self.captures >= MOST_CAPTURES:
                return list(function(*inputs))
            if self.calls <= CALLS_FIRST or not self._captured(function, inputs, pure):
                return self._called(function, inputs)
        _place(self.inputs, inputs)
        assert self.replay is not None
        *found, answers = self.replay()
        if answers is not None and answers.tolist() != self.asked.answers:
            # Nothing was changed yet: a function that is not pure asks for no decision.
            self.replay = None
            return self._called(function, inputs)
        return found

    def _called(self, function: Function, inputs: Columns) -> list[Tensor | None]:
        with _asking(_Asked()) as asked:
            found = self.recorder.call(lambda: list(function(*inputs)))
        self.asked = asked
        return found

    def _captured(self, function: Function, inputs: Columns, pure: bool) -> bool:
        """Whether ``function`` could be captured, and a replay does what a call does."""
        self.captures += 1
        self.inputs = list(inputs)

        def whole() -> list[Tensor | None]:
            with _asking(_Told(self.asked)) as told:
                found = list(function(*self.inputs))
            return [*found, torch.stack(told.tensors) if told.tensors else None]

        try:
            self.replay = self.recorder.capture(whole)
            if pure and not _alike(self.replay()[:-1], self._called(function, inputs)):
                raise RuntimeError("a replay does not give what a call does")
        except Exception as error:  # whatever the code of a problem does that a graph cannot hold
            self.replay, self.captures = None, MOST_CAPTURES
            log.debug("%s is not captured: %s", self.key, next(iter(str(error).splitlines()), type(error).__name__))
            return False
        return True


class Recorder:
    """How functions without arguments are captured: here not at all, but all else goes on as if they were."""

    def call(self, function: Callable[[], list[Tensor | None]]) -> list[Tensor | None]:
        """``function()``, before it is captured."""
        return function()

    def capture(self, function: Callable[[], list[Tensor | None]]) -> Callable[[], list[Tensor | None]]:
        """What does all of ``function`` again, and leaves what it finds in the same tensors."""
        kept = [None if t is None else t.clone() for t in function()]

        def replay() -> list[Tensor | None]:
            _place(kept, function())
            return kept

        return replay


class CudaRecorder(Recorder):
    """In a CUDA graph."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None

    def call(self, function: Callable[[], list[Tensor | None]]) -> list[Tensor | None]:
        # On a stream of its own, as captures are: libraries then have made what they keep for each stream.
        self._stream = self._stream or torch.cuda.Stream()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            found = function()
        torch.cuda.current_stream().wait_stream(self._stream)
        return found

    def capture(self, function: Callable[[], list[Tensor | None]]) -> Callable[[], list[Tensor | None]]:
        graph = torch.cuda.CUDAGraph()
        # What other threads ask of the device meanwhile is none of this graph.
        with torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"):
            kept = function()

        def replay() -> list[Tensor | None]:
            graph.replay()
            return kept

        return replay


class _Asked(TorchFunctionMode):
    """Answers questions by looking, and remembers what it said, and the constants that were made."""

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


class _Told(TorchFunctionMode):
    """Answers questions as they were ``before``, keeping them to be checked, and gives out the constants of then."""

    def __init__(self, before: _Asked) -> None:
        super().__init__()
        self.answers, self.constants, self.tensors = before.answers, iter(before.constants), []  # type: ignore[var-annotated]

    def answer(self, asked: Tensor) -> int:
        self.tensors.append(asked.long())
        return self.answers[len(self.tensors) - 1]

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if _makes(func, args) or func is Tensor.to and args[0].is_cpu and _goes(args[1:], kwargs):
            return next(self.constants).clone()  # whoever was given it may change it
        return func(*args, **(kwargs or {}))


def _makes(func: Any, args: Any) -> bool:
    """Whether a tensor is made of Python's numbers."""
    data = args[1:2] if func is Tensor.new_tensor else args[:1]
    return func in MAKERS and len(data) == 1 and not isinstance(data[0], Tensor)


def _goes(args: Any, kwargs: Any) -> bool:
    """Whether `Tensor.to` with these arguments leads from the CPU to another device."""
    given = [*args, *(kwargs or {}).values()]
    devices = [a.device if isinstance(a, Tensor) else a for a in given if isinstance(a, Tensor | torch.device | str)]
    return any(torch.device(d).type != "cpu" for d in devices)


_oracle: contextvars.ContextVar[_Asked | _Told | None] = contextvars.ContextVar("oracle", default=None)


@contextmanager
def _asking(oracle: Any) -> Iterator[Any]:
    token = _oracle.set(oracle)
    try:
        with oracle:
            yield oracle
    finally:
        _oracle.reset(token)


def decided(asked: Tensor) -> int:
    """``int(asked)`` of a whole number or flag ``()``, on which the course of a function depends."""
    oracle = _oracle.get()
    return int(asked) if oracle is None else oracle.answer(asked)


def _place(kept: Columns, given: Columns) -> None:
    """Copy what was ``given`` to where it was ``kept``, each entry of what is expanded once."""
    for old, new in zip(kept, given, strict=True):
        if old is not None and new is not None and old is not new:
            once = tuple(slice(0, 1) if step == 0 else slice(None) for step in old.stride())
            old[once].copy_(new[once])


def _alike(left: Columns, right: Columns) -> bool:
    """Whether they agree but for rounding, where both are finite."""
    for one, other in zip(left, right, strict=True):
        if one is not None and other is not None:
            apart = (one.double() - other.double()).abs().nan_to_num(0.0, 0.0, 0.0)
            if bool((apart > ROUNDING * other.double().abs().nan_to_num(0.0, 0.0, 0.0).max()).any()) and other.numel():
                return False
    return True
