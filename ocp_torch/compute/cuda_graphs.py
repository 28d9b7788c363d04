"""Functions of tensors that are called again and again, on a GPU from a CUDA graph: a step of small networks is hundreds of
kernels, each of which takes longer to be started than to run, and a graph starts them at once.

A captured function does what it did when it was captured. What it reads beside its tensors must stay where it is in memory,
or be a constant; it draws no random numbers. Where its course depends on numbers it asks `decided`, and each replay checks
that the answers would be the same. Whether a replay gives what a call gives is looked at after a capture, and now and then.
"""

import logging
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

from ocp_torch.compute.decisions import DecisionRecorder, DecisionReplayer, listening
from ocp_torch.errors import first_line

log = logging.getLogger(__name__)

Columns = Sequence[Tensor | None]
Function = Callable[..., Columns]

CALLS_BEFORE_CAPTURE = 2  # in which a function makes what it makes once, and its decisions and constants are noted
MOST_CAPTURES = 3  # after which a function whose course keeps changing is called as it is
CHECK_EVERY = 200  # replays after which one is compared with a call, which takes about five times as long
# Their largest difference, relative to the largest entry: in float32 sums in another order differ by less.
TOLERANCE = 1e-5


CHANGED = (
    "warning: a problem or a method gives something else for the same states than before; it was noticed after up to %d "
    "steps, and graphs are not used for it any more. Where that is meant, set trainer.graphs=false."
)


class Eager:
    """Calls functions as they are."""

    captures = False

    def __call__(self, key: Hashable, function: Function, inputs: Columns, pure: bool = True) -> list[Tensor | None]:
        """``function(*inputs)``, a list of tensors. ``key`` says which function it is: with an equal key and inputs of equal
        forms it must do the same. One that is not ``pure`` changes what it reads, and asks for no decision."""
        return list(function(*inputs))

    def number(self, value: float, like: Tensor) -> Any:
        """``value``, which changes from call to call, as an input of a function."""
        return value

    def fresh(self) -> "Eager":
        """A new one of this kind."""
        return self

    def forget(self) -> None:
        """Drop all captures, since what they read has been replaced."""


class CudaGraphs(Eager):
    """Captures functions at their third call. Inputs are copied to where the capture found them, unless they are there; what
    is returned stays in place, and is overwritten by the next call. A function that cannot be captured is called."""

    captures = True

    def __init__(self, recorder: Any = None) -> None:
        self.recorder = recorder or CudaRecorder()
        self._functions: dict[Hashable, _Replayed] = {}

    def __call__(self, key: Hashable, function: Function, inputs: Columns, pure: bool = True) -> list[Tensor | None]:
        whole = (key, tuple(None if t is None else (t.shape, t.stride(), t.dtype, t.device) for t in inputs))
        return self._functions.setdefault(whole, _Replayed(key, self.recorder))(function, inputs, pure)

    def number(self, value: float, like: Tensor) -> Tensor:
        return torch.full((), value, dtype=like.dtype, device=like.device)

    def fresh(self) -> "CudaGraphs":
        return CudaGraphs(self.recorder)

    def forget(self) -> None:
        self._functions.clear()


def replays_on(device: torch.device) -> Eager:
    """`CudaGraphs` where ``device`` is a GPU, which alone has graphs; else `Eager`."""
    return CudaGraphs() if device.type == "cuda" else Eager()


class _Replayed:
    """The calls, captures and replays of a function with inputs of one form."""

    def __init__(self, key: Hashable, recorder: Any) -> None:
        self.key, self.recorder = key, recorder
        self.calls = self.captures = self.replays = 0
        self.replay: Callable[[], list[Tensor | None]] | None = None

    def __call__(self, function: Function, inputs: Columns, pure: bool) -> list[Tensor | None]:
        self.calls += 1
        if self.replay is None:
            if self.captures >= MOST_CAPTURES:
                return list(function(*inputs))
            if self.calls <= CALLS_BEFORE_CAPTURE or not self._captured(function, inputs):
                return self._called(function, inputs)
        _place(self.inputs, inputs)
        assert self.replay is not None
        *found, answers = self.replay()
        if answers is not None and answers.tolist() != self.noted.answers:
            self.replay = None  # it took another course; nothing was changed by that, as it is pure
            return self._called(function, inputs)
        self.replays += 1
        if pure and self.replays % CHECK_EVERY == 1:
            called = self._called(function, inputs)
            if not _alike(found, called):
                if self.replays > 1:
                    log.warning(CHANGED, CHECK_EVERY)
                self._refuse("a replay does not give what a call does")
                return called
        return found

    def _called(self, function: Function, inputs: Columns) -> list[Tensor | None]:
        noted = DecisionRecorder()
        with listening(noted):
            found = self.recorder.call(lambda: list(function(*inputs)))
        self.noted = noted
        return found

    def _captured(self, function: Function, inputs: Columns) -> bool:
        """Whether ``function`` could be captured, with ``inputs`` where they are."""
        self.captures, self.replays, self.inputs = self.captures + 1, 0, list(inputs)

        def whole() -> list[Tensor | None]:
            told = DecisionReplayer(self.noted)
            with listening(told):
                found = list(function(*self.inputs))
            return [*found, torch.stack(told.questions) if told.questions else None]

        try:
            self.replay = self.recorder.capture(whole)
        except Exception as error:  # whatever the code of a problem does that a graph cannot hold
            self._refuse(first_line(error))
        return self.replay is not None

    def _refuse(self, reason: str) -> None:
        """Call the function as it is from now on."""
        self.replay, self.captures = None, MOST_CAPTURES
        log.debug("%s is not replayed: %s", self.key, reason)


class CudaRecorder:
    """Captures functions without arguments in CUDA graphs."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None

    def call(self, function: Callable[[], list[Tensor | None]]) -> list[Tensor | None]:
        """``function()`` on the stream of the captures, for which libraries then have made what they keep."""
        self._stream = self._stream or torch.cuda.Stream()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            found = function()
        torch.cuda.current_stream().wait_stream(self._stream)
        return found

    def capture(self, function: Callable[[], list[Tensor | None]]) -> Callable[[], list[Tensor | None]]:
        """A function that does all of ``function`` again, and leaves what it finds in the same tensors."""
        graph = torch.cuda.CUDAGraph()
        # What other threads ask of the device meanwhile does not belong to this graph.
        with torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local"):
            kept = function()

        def replay() -> list[Tensor | None]:
            graph.replay()
            return kept

        return replay


def _place(kept: Columns, given: Columns) -> None:
    """Copy what was ``given`` to where it was ``kept``, each entry of what is expanded once."""
    for old, new in zip(kept, given, strict=True):
        if old is not None and new is not None and old is not new:
            once = tuple(slice(0, 1) if step == 0 else slice(None) for step in old.stride())
            old[once].copy_(new[once])


def _alike(left: Columns, right: Columns) -> bool:
    """Whether ``left`` and ``right`` agree up to rounding, and in where they are not finite."""
    for one, other in zip(left, right, strict=True):
        if one is not None and other is not None and other.numel():
            size = float(other.double().abs().nan_to_num(0.0, 0.0, 0.0).max())
            if not torch.allclose(one.double(), other.double(), rtol=0.0, atol=TOLERANCE * size, equal_nan=True):
                return False
    return True
