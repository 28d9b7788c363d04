"""A user's function called by several processes, each of which finds it by its name (`worker`)."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import weakref
from multiprocessing.connection import Connection, Pipe

import numpy as np

from ocp_torch.errors import InputError
from ocp_torch.problems.simulator import worker
from ocp_torch.problems.simulator.target import joined

# Seconds that a process has to end by itself, so that a simulator can clean up, before it is killed.
PATIENCE = 2.0
DIED = "a process of problem.workers died; try problem.workers=1 to see why."


class Workers:
    """``count`` processes that each import ``target``, found where this process would find it.

    They start at the first `map`, and end with this object or with this process, however it ends: each waits for a pipe
    to close that only this process holds open. Not forked, for a process with threads, as PyTorch has, must not be. A copy of
    this process starts others: from those of this one both would read the other's answers.
    """

    def __init__(self, target: str, count: int) -> None:
        self.count = count
        self._given = (target, list(sys.path), os.getcwd())
        self._team: list[tuple[subprocess.Popen, Connection]] = []
        self._end = lambda: None
        self._home = os.getpid()

    def map(self, x: np.ndarray, one_by_one: bool) -> tuple:
        """The answers at ``x``, each process with its part of the rows. Raises what the function raises."""
        parts = [part for part in np.array_split(x, self.count) if len(part)]
        try:
            if not self._team or self._home != os.getpid():
                self._start()
            team = [connection for _, connection in self._team[: len(parts)]]
            for connection, part in zip(team, parts, strict=True):
                connection.send((part, one_by_one))
            found = [connection.recv() for connection in team]
        except (EOFError, ConnectionError, pickle.UnpicklingError):
            self.close()
            raise InputError(DIED) from None
        except BaseException:
            self.close()  # else the next `map` would read the answers that are still on their way
            raise
        for good, answer in found:
            if not good:
                raise answer
        return joined([answer for _, answer in found], np.concatenate)

    def _start(self) -> None:
        # However this process ends, its end of the pipe closes; children get the reading end alone.
        lifeline, held = os.pipe()
        self._team, self._home = [], os.getpid()
        self._end = weakref.finalize(self, _dismiss, self._team, held)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
        try:
            for _ in range(self.count):
                self._team.append(_one(lifeline))
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            os.close(lifeline)
        for _, connection in self._team:
            connection.send(self._given)

    def close(self) -> None:
        """End the processes; the next `map` starts others."""
        self._end()
        self._team = []


def _one(lifeline: int) -> tuple[subprocess.Popen, Connection]:
    """One process, which finds the signals blocked until it can deal with them, and the connection to it."""
    ours, theirs = Pipe()
    mortal = threading.current_thread() is threading.main_thread()
    numbers = (theirs.fileno(), lifeline, os.getpid(), int(mortal))
    command = [sys.executable, worker.__file__, *map(str, numbers)]
    try:
        process = subprocess.Popen(command, pass_fds=numbers[:2], stdin=subprocess.DEVNULL)
    finally:
        theirs.close()
    return process, ours


def _dismiss(team: list[tuple[subprocess.Popen, Connection]], held: int) -> None:
    for _, connection in team:
        connection.close()
    for process, _ in team:
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    os.close(held)
