"""Processes of a simulator end with whoever started them, at any moment, and do not heed what is meant for him."""

import os
import signal
import sys
import textwrap
import time

import numpy as np
import pytest

from ocp_torch.problems.simulator.workers import Workers
from support.processes import alive, descendants, linux, wait_until

MODULE = """
import ctypes, os, subprocess, time
import numpy as np

def fast(x):
    return np.ones(len(x)), None, np.ones((len(x), 1, 1))

def forever(x):
    open(f"asked_{os.getpid()}", "w").close()
    time.sleep(600.0)

def deaf(x):  # compiled code that lets no other thread run
    open(f"asked_{os.getpid()}", "w").close()
    ctypes.PyDLL(None).sleep(600)

def lost(x):
    os._exit(3)

class Odd(Exception):
    def __init__(self, one, two):
        super().__init__(one)

def odd(x):
    raise Odd("left", "right")

def patient(x):
    child = subprocess.Popen(["sleep", "600"])
    child.terminate()
    child.wait(timeout=5.0)
    return fast(x)
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "simulators.py").write_text(textwrap.dedent(MODULE))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    sys.modules.pop("simulators", None)


def asking(target: str) -> int:
    """A process that asks two workers for ``target``, as a run does."""
    process = os.fork()
    if process == 0:
        try:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            Workers(target, 2).map(np.zeros((4, 1)), False)
        finally:
            os._exit(0)
    return process


@linux
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("pause", [0.0, 0.02, 0.1, 0.3])
def test_while_they_start_they_end_with_their_parent(number, pause, module):
    process = asking("simulators:forever")
    wait_until(lambda: descendants(process))
    time.sleep(pause)
    workers = descendants(process)
    os.kill(process, number)
    os.waitpid(process, 0)
    wait_until(lambda: not alive(workers), 5.0)


@linux
@pytest.mark.nightly
@pytest.mark.parametrize("target", ["simulators:forever", "simulators:deaf"])
def test_in_the_middle_of_somebodys_code_they_end_with_their_parent(target, module):
    process = asking(target)
    wait_until(lambda: len(list(module.glob("asked_*"))) == 2)
    workers = descendants(process)
    assert len(workers) == 2
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    wait_until(lambda: not alive(workers), 5.0)


@linux
@pytest.mark.nightly
def test_signals_to_the_whole_group_are_the_parents_and_the_pool_goes_on(module):
    pool, x = Workers("simulators:fast", 2), np.zeros((4, 1))
    before = descendants(os.getpid())
    pool.map(x, False)
    team = descendants(os.getpid()) - before
    assert len(team) == 2
    for number in (signal.SIGINT, signal.SIGTERM):
        for worker in team:
            os.kill(worker, number)
    time.sleep(0.2)
    assert len(pool.map(x, False)[0]) == 4
    assert descendants(os.getpid()) - before == team
    del pool
    wait_until(lambda: not alive(team), 5.0)


@linux
def test_a_copy_of_the_process_has_workers_of_its_own(module):
    pool, x = Workers("simulators:fast", 2), np.zeros((4, 1))
    pool.map(x, False)
    before = descendants(os.getpid())
    reading, writing = os.pipe()
    copy = os.fork()
    if not copy:
        try:
            pool.map(x, False)
            os.write(writing, b"".join(b"%d " % pid for pid in descendants(os.getpid())))
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        own = {int(pid) for pid in pipe.read().split()}
    os.waitpid(copy, 0)
    assert len(own) == 2
    assert not own & before
    wait_until(lambda: not alive(own), 5.0)
    assert len(pool.map(x, False)[0]) == 4


@pytest.mark.nightly
def test_a_lost_process_an_odd_exception_and_a_simulators_own_processes(module):
    x = np.zeros((4, 1))
    with pytest.raises(ValueError, match=r"a process of problem.workers died; try problem.workers=1"):
        Workers("simulators:lost", 2).map(x, False)
    with pytest.raises((TypeError, RuntimeError)):
        Workers("simulators:odd", 2).map(x, False)
    assert len(Workers("simulators:patient", 2).map(x, False)[0]) == 4
