"""SIGTERM and Ctrl-C: the first lets the step in hand finish and the state be saved, the second stops at once."""

import os
import signal
import threading
from types import FrameType

CAUGHT = (signal.SIGTERM, signal.SIGINT)


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
    """While it is entered, holds back the first signal for the trainer to `take`; where no step is in hand and the state is
    saved (``saved = True``) the first one already raises `Preempted`."""

    def __init__(self) -> None:
        self.received: int | None = None
        self.saved = False
        self._before: dict = {}

    def __enter__(self) -> "Signals":
        # Only the main thread may; elsewhere whoever runs this decides what a signal does.
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._caught) for number in CAUGHT}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _caught(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            os._exit(128 + number)  # every file is replaced in one step, so there is nothing to tidy
        self.received = number
        if self.saved:
            raise Preempted(number)

    def take(self) -> None:
        """Raise `Preempted` if a signal came."""
        if self.received is not None:
            raise Preempted(self.received)
