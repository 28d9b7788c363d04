"""Work that a copy of this process may begin on another core, before its answer is asked for.

Threads of Python take turns wherever PyTorch's operations are short: of two simulations that took 39 s one after the other
two threads made 33, and two processes 23.
"""

import contextlib
import ctypes
import fcntl
import logging
import os
import select
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import torch

from ocp_torch.compute import threads
from ocp_torch.compute.packing import packed, unpacked
from ocp_torch.compute.processes import here

T = TypeVar("T")

# Seconds without any CPU time after which a copy is given up: a lock that a thread held at the fork is never released in it.
PATIENCE = 20.0
PR_SET_PDEATHSIG = 1  # of `prctl`: the signal that a process gets when its parent dies


class Copy(NamedTuple):
    """A copy of this process: its number, the end of a pipe that it answers through, and the cores that it may use."""

    pid: int
    pipe: int
    cores: int


class BackgroundResult(Generic[T]):
    """The value of ``work``, which a copy of this process may begin before that is asked for.

    The answer is the same: ``work`` must be a function of nothing that changes meanwhile, and use no global random numbers;
    what it changes stays in the copy, and what it prints or warns of is not seen. ``shared`` are objects that it returns
    parts of and that are the same afterwards: they are not sent back. Where there is no second core, where processes cannot
    be copied safely, and where a copy fails, whoever asks does the work.
    """

    def __init__(self, work: Callable[[], T], *shared: object) -> None:
        self._work, self._shared = work, shared
        self._copy: Copy | None = None
        self._answer: list[T] = []

    @contextlib.contextmanager
    def ahead(self, allowed: bool = True) -> Iterator[None]:
        """A context in which the work goes on meanwhile, if that is ``allowed``; at its end what is not done is left."""
        try:
            if allowed:
                self.begin()
            yield
        finally:
            self.stop()

    def begin(self) -> None:
        """Go on in a copy of this process, where there is a core for it."""
        if self._copy is None and not self._answer and threads.cores() > 1 and _can_be_copied():
            # There may be too many processes or files, or too little memory.
            with contextlib.suppress(OSError), _signals_held() as before:
                self._copy = _copied(lambda: packed(self._work(), *self._shared), before)

    def answer(self) -> T:
        """The value, once the work is done. Raises what the work raises."""
        if self._copy is not None:
            try:
                said = _said_by(self._copy)
            finally:
                self.stop()
            with contextlib.suppress(Exception):  # cut off, or whatever a stranger's object may raise
                self._answer.append(unpacked(said, *self._shared))
        if not self._answer:
            self._answer.append(self._work())
        return self._answer[0]

    def stop(self) -> None:
        """Leave what is not done; whoever asks later does it all."""
        if self._copy is not None:
            copy, self._copy = self._copy, None
            _ended(copy)


def _can_be_copied() -> bool:
    """Whether a copy of this process can go on: on Linux, outside of torchrun, and where neither OpenMP nor CUDA nor autograd
    have threads, which a copy lacks."""
    one_thread = torch.get_num_threads() == 1 and not torch.cuda.is_available()
    return sys.platform == "linux" and one_thread and here().size == 1 and _ticks(os.getpid()) is not None


@contextlib.contextmanager
def _signals_held() -> Iterator[set[int]]:
    """A context in which signals wait, with those that were held before: in a copy that has not parted from this process yet
    an exception from a handler would go to whatever has called this, and all of that would go on in the copy too."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    try:
        yield before
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _copied(work: Callable[[], bytes], held: set[int]) -> Copy:
    """A copy of this process that does ``work`` on half of the cores and writes what comes of it into a pipe; once it has
    parted from this one, it holds back no signals but those that were ``held`` before."""
    own, parent = threads.cores() // 2, os.getpid()
    reading, writing = os.pipe()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # that other threads are not copied
            pid = os.fork()
    except OSError:
        os.close(reading)
        os.close(writing)
        raise
    if pid:
        os.close(writing)
        threads.taken += own
        return Copy(pid, reading, own)
    try:
        os.close(reading)
        pipe = fcntl.fcntl(writing, fcntl.F_DUPFD_CLOEXEC, 3)  # it may have the number of a stream that is closed
        os.close(writing)
        _leave(parent)
        signal.pthread_sigmask(signal.SIG_SETMASK, held)
        threads.alone(own)
        said = work()
        with os.fdopen(pipe, "wb") as answers:
            answers.write(said)
    finally:
        os._exit(0)  # neither buffers nor exit functions are for a copy


def _leave(parent: int) -> None:
    """Part a copy from the terminal and the log of its ``parent``, and have it die with that."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it died before
        os._exit(1)
    for number in signal.valid_signals():
        if callable(signal.getsignal(number)):  # a function of the user's, which the parent calls
            signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    logging.disable()
    sys.stdout = sys.stderr = nowhere = open(os.devnull, "r+")  # those of a notebook are no files
    for stream in range(3):
        os.dup2(nowhere.fileno(), stream)


def _said_by(copy: Copy) -> bytes:
    """What ``copy`` writes until it ends; nothing where it fails, or waits for what never comes."""
    before, said, ready = _ticks(copy.pid), bytearray(), select.poll()
    ready.register(copy.pipe, select.POLLIN)
    while True:
        if ready.poll(1000.0 * PATIENCE):
            part = os.read(copy.pipe, 2**20)
            said += part
            if not part:
                return bytes(said)
        elif (after := _ticks(copy.pid)) == before:
            return b""
        else:
            before = after


def _ended(copy: Copy) -> None:
    """End ``copy``, if it has not ended by itself, and take back what it had."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(copy.pid, signal.SIGKILL)
    os.close(copy.pipe)
    threads.taken -= copy.cores
    with contextlib.suppress(ChildProcessError):  # where the program has the system forget ended processes
        os.waitpid(copy.pid, 0)


def _ticks(pid: int) -> Any:
    """The CPU time that the process ``pid`` has used, in ticks; `None` where the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return int(fields[11]) + int(fields[12])
    except (OSError, ValueError, IndexError):
        return None
