"""A user's function: found by its name, and called for a whole batch of states, one by one, or by several processes."""

import importlib
import importlib.util
import os
import pickle
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from pathlib import Path

import numpy as np

from ocp_torch.errors import InputError, nearest
from ocp_torch.files.reading import kind, require_file
from ocp_torch.problems.simulator import worker

# Seconds that a process has to end by itself, so that a simulator can clean up, before it is killed.
PATIENCE = 2.0
DIED = "a process of problem.workers died; try problem.workers=1 to see why."


def resolved(target: str, field: str = "problem.target") -> Callable:
    """The function that module:function or FILE.py:function names; ``field`` names the setting in the `InputError`."""
    source, _, name = target.rpartition(":")
    if not source or not name:
        raise InputError(f"{field} is {target!r}, but must be module:function or FILE.py:function.")
    try:
        if source.endswith(".py"):
            if kind(source) is None:
                raise InputError(f"{field} names {source}, which does not exist.")
            require_file(source)
            spec = importlib.util.spec_from_file_location(Path(source).stem, source)
            assert spec is not None  # as for every .py file
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules.setdefault(Path(source).stem, module)
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(source)
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # whatever a stranger's module may raise
        raise InputError(f"{field} = {target} cannot be imported: {type(error).__name__}: {error}.") from None
    if not callable(found := getattr(module, name, None)):
        known = [n for n, v in vars(module).items() if callable(v) and not n.startswith("_")]
        raise InputError(f"{field} = {target}: the module has no function {name!r}{nearest(name, known)}.")
    return found


def asked(function: Callable, x: np.ndarray, one_by_one: bool):
    """``function`` at the states ``x`` ``(N, d)``, all at once or one by one."""
    try:
        if not one_by_one:
            return function(x.copy())
        return joined([function(state.copy()) for state in x], np.stack)
    except SystemExit as end:  # it would end the run without a word
        raise RuntimeError(f"it asks Python to exit (status {end.code})") from None


def joined(answers: list, join: Callable):
    """The ``answers`` at parts of the states as one answer: each column put together by ``join``, `None` where one is."""
    if not all(isinstance(answer, tuple | list) for answer in answers):
        return answers[0]
    columns = zip(*answers, strict=True)
    return tuple(None if any(p is None for p in parts) else join([np.asarray(p) for p in parts]) for parts in columns)


class Workers:
    """``count`` processes that each import ``target``, found where this process would find it.

    They start at the first `map`, and end with this object or with this process, however it ends: each waits for a pipe
    to close that only this process holds open. Not forked, for a process with threads, as PyTorch has, must not be.
    """

    def __init__(self, target: str, count: int) -> None:
        self.count = count
        self._given = (target, list(sys.path), os.getcwd())
        self._team: list[tuple[subprocess.Popen, Connection]] = []
        self._end = lambda: None

    def map(self, x: np.ndarray, one_by_one: bool) -> tuple:
        """The answers at ``x``, each process with its part of the rows. Raises what the function raises."""
        parts = [part for part in np.array_split(x, self.count) if len(part)]
        try:
            if not self._team:
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
