"""Why a run stops: its steps are done, a limit is reached, or SIGTERM or Ctrl-C came, of which the first lets the step in
hand finish and the state be saved, and the second stops at once."""

import os
import signal
import threading
from collections.abc import Sequence
from types import FrameType

from ocp_torch.training.settings import TrainerSettings
from ocp_torch.training.state import TrainState

STEPS, TARGET_GAP, MAX_SECONDS = "steps", "target_gap", "max_seconds"
SOLVED = "solved"  # Gauss-Newton steps found the solution before all others were made
NOT_FINITE, FAILED = "not_finite", "failed"
ASKED = "callback"  # the user's callback asked for it
# After a full certificate that did not reach the target gap, the next is tried at this multiple of the step: even a long run
# makes few, and stops at most a quarter later than it could.
RETRY_FACTOR = 1.25
CAUGHT_SIGNALS = (signal.SIGTERM, signal.SIGINT)


def late(settings: TrainerSettings, state: TrainState) -> bool:
    """Whether the seconds of `trainer.max_seconds` are over."""
    return settings.max_seconds is not None and state.elapsed >= settings.max_seconds


def reason_to_stop(settings: TrainerSettings, state: TrainState, over: bool) -> str | None:
    """The reason to stop before the next step, or `None`; ``over`` says whether it is `late`, here or elsewhere."""
    if state.pending:
        return TARGET_GAP
    if state.solved and settings.newton_after:  # else more steps were asked for since
        return SOLVED
    return MAX_SECONDS if over else None


def in_words(reason: str, settings: TrainerSettings, state: TrainState, good: bool) -> str:
    """``reason`` as a sentence for the user; ``good`` says whether a measured gap made another round needless."""
    at = f"step {state.step:,}"
    if reason == MAX_SECONDS:
        return f"trainer.max_seconds = {settings.max_seconds:g} are over, at {at} of {settings.end(state.round):,}"
    if reason == ASKED:
        return f"the callback asked for it, at {at} of {settings.end(state.round):,}"
    if reason == SOLVED:
        return (
            f"Gauss-Newton steps after {at} solve the Hamilton-Jacobi-Bellman equation, and a quick evaluation agrees"
        )
    if reason == TARGET_GAP:
        return f"a quick evaluation at {at} finds trainer.target_gap = {settings.target_gap:g} reached"
    met = f", and trainer.good_gap = {settings.good_gap:g} is met" if good else ""
    return f"all {state.step:,} steps are done{met}"


def postpone(state: TrainState) -> None:
    """The full certificate did not reach the target gap: training goes on, and it is tried again later."""
    state.pending, state.retry = False, round(RETRY_FACTOR * state.step)


class Preempted(BaseException):
    """The run was asked to stop, and its state is saved. No `Exception`: nothing on the way may swallow it."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number

    @property
    def status(self) -> int:
        """The conventional exit status: 143 for SIGTERM, 130 for Ctrl-C."""
        return 128 + self.number


class Signals:
    """A context that holds back the first signal for the trainer to `take`; where no step is in hand and the state is saved
    (``saved = True``) the first one already raises `Preempted`. The second ends the process, if it is the run's own
    (``exits``), and else raises `Preempted` too. Where the run is ``ending`` by itself, later signals do nothing."""

    def __init__(self, exits: bool = True) -> None:
        self._exits = exits
        self.ending = False
        self.received: int | None = None
        self.saved = False
        self._before: dict = {}

    def __enter__(self) -> "Signals":
        # Only the main thread may set handlers; elsewhere the calling program decides what a signal does.
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._caught) for number in CAUGHT_SIGNALS}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self.ending else handler)

    def _caught(self, number: int, frame: FrameType | None) -> None:
        again = self.received is not None
        if again and self._exits:
            os._exit(128 + number)  # every file is replaced in one step, so there is nothing to tidy
        self.received = number
        if again or self.saved:
            raise Preempted(number)

    def came(self) -> list[bool]:
        """Whether each of `CAUGHT_SIGNALS` came."""
        return [number == self.received for number in CAUGHT_SIGNALS]

    def raise_first(self, came: Sequence[bool]) -> None:
        """Raise `Preempted` by the first of `CAUGHT_SIGNALS` that ``came``, here or to another process."""
        raise Preempted(next(number for number, yes in zip(CAUGHT_SIGNALS, came, strict=True) if yes))

    def take(self) -> None:
        """Raise `Preempted` if a signal came."""
        if self.received is not None:
            raise Preempted(self.received)
