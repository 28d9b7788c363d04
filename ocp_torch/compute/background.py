"""Work that a second core may begin before its answer is asked for."""

import threading
from collections.abc import Generator
from typing import Generic, TypeVar

import torch

from ocp_torch.compute.threads import cores

T = TypeVar("T")


class BackgroundResult(Generic[T]):
    """The value that the generator ``work`` returns, whose yields part it into pieces after which it can be stopped.

    A call of `answer` does the work, unless it was begun before in a thread of its own. The answer is the same: ``work`` must
    use no global random numbers, and share only what is not changed with what goes on beside it.
    """

    def __init__(self, work: Generator[None, None, T]) -> None:
        self._work = work
        self._thread: threading.Thread | None = None
        self._stopped = threading.Event()
        self._answer: list[T] = []
        self._error: BaseException | None = None

    def begin(self) -> None:
        """Go on in a thread of its own, where there is a second core."""
        if self._thread is None and not self._answer and cores() > 1:
            threads = (torch.get_num_threads(),)
            self._thread = threading.Thread(target=self._run, args=threads, name="ocp_torch ahead", daemon=True)
            self._thread.start()

    def answer(self) -> T:
        """The value, once the work is done. Raises what the work raises."""
        if self._thread is not None:
            self._thread.join()
        if not self._answer and self._error is None:  # it was never begun, or stopped
            self._stopped.clear()
            self._run()
        if self._error is not None:
            raise self._error
        return self._answer[0]

    def stop(self) -> None:
        """Leave what is not done, and wait for the piece in hand."""
        if self._thread is not None:
            self._stopped.set()
            self._thread.join()

    def _run(self, threads: int | None = None) -> None:
        if threads is not None:  # a new thread would take as many of PyTorch's as there are cores
            torch.set_num_threads(threads)
        try:
            while not self._stopped.is_set():
                next(self._work)
        except StopIteration as end:
            self._answer.append(end.value)
        except BaseException as error:  # raised by `answer`
            self._error = error
