"""Work begun in a copy of the process: the same answer, errors for whoever asks, and an end when nobody wants it any more."""

import os
import signal
import subprocess
import sys
import threading
import time
import warnings
from typing import NoReturn

import pytest
import torch

from ocp_torch.compute import background, threads
from ocp_torch.compute.background import BackgroundResult
from ocp_torch.compute.packing import packed, unpacked

DEADLINE = 60.0

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are copied on Linux alone")


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(threads, "cores", lambda: 2 - threads.taken)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
    assert threads.taken == 0


def begun(work, *shared) -> BackgroundResult:
    job = BackgroundResult(work, *shared)
    job.begin()
    return job


def refused() -> NoReturn:
    raise BlockingIOError("there are too many")


def ended(pid: int) -> bool:
    """Whether there is no process ``pid`` any more, not even one that nobody has waited for."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def copy_of(job: BackgroundResult) -> int:
    assert job._copy is not None
    return job._copy.pid


def test_the_answer_is_that_of_a_copy_where_there_is_a_core_for_it(two_cores):
    job = begun(os.getpid)
    pid = copy_of(job)
    assert threads.cores() == 1
    assert job.answer() == job.answer() == pid != os.getpid()
    assert ended(pid)
    assert threads.cores() == 2


@pytest.mark.parametrize(
    "obstacle",
    [
        lambda patch: patch.setattr(threads, "cores", lambda: 1),
        lambda patch: patch.setattr(torch, "get_num_threads", lambda: 2),
        lambda patch: patch.setattr(torch.cuda, "is_available", lambda: True),
        lambda patch: patch.setattr(sys, "platform", "darwin"),
        lambda patch: patch.setattr(background, "_ticks", lambda pid: None),
        lambda patch: patch.setattr(os, "fork", refused),
        lambda patch: patch.setattr(os, "pipe", refused),
    ],
    ids=["one core", "more threads", "a GPU", "another system", "no /proc", "no more processes", "no more files"],
)
def test_elsewhere_whoever_asks_does_the_work(obstacle, two_cores, monkeypatch):
    obstacle(monkeypatch)
    assert begun(os.getpid).answer() == os.getpid()


def test_without_a_beginning_whoever_asks_does_the_work():
    assert BackgroundResult(os.getpid).answer() == os.getpid()


def test_a_copy_takes_only_the_cores_that_are_left(two_cores):
    first, second = begun(os.getpid), begun(os.getpid)
    assert second.answer() == os.getpid() != first.answer()


def test_tensors_come_back_bitwise_and_what_is_shared_is_the_same_object(two_cores):
    generator = torch.Generator().manual_seed(0)
    wide = torch.randn(2, 2048, 64, dtype=torch.float64, generator=generator)
    part = wide[0]
    product, same = begun(lambda: (part.T @ wide[1], part), part).answer()
    assert torch.equal(product, part.T @ wide[1])
    assert same is part


def test_of_a_view_only_what_it_shows_is_packed():
    whole = torch.arange(100_000.0)
    said = packed(whole[5:8])
    assert len(said) < 5_000
    assert torch.equal(unpacked(said), whole[5:8])
    twice = packed([whole, whole])
    assert len(twice) < 1.5 * whole.nbytes


def test_a_column_stays_one_so_that_its_sum_does():
    x = torch.randn(4000, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for view in (x[:, 2], x[:, :5], x[3:900].T, x[0].expand(4, 7)):
        again = unpacked(packed(view))
        assert again.stride() == view.stride()
        assert torch.equal(again, view)
        assert torch.equal(again.sum(), view.sum())


def test_sparse_tensors_are_packed_too():
    sparse = torch.eye(5).to_sparse()
    assert torch.equal(unpacked(packed(sparse)).to_dense(), torch.eye(5))


def test_an_error_reaches_whoever_asks(two_cores):
    def failing():
        raise ArithmeticError("no number")

    job = begun(failing)
    for _ in range(2):
        with pytest.raises(ArithmeticError, match="no number"):
            job.answer()


def test_where_an_answer_cannot_be_sent_whoever_asks_does_the_work(two_cores):
    lock = threading.Lock()
    assert begun(lambda: (lock, os.getpid())).answer() == (lock, os.getpid())


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_where_a_copy_is_killed_whoever_asks_does_the_work(end, two_cores):
    here = os.getpid()
    job = begun(lambda: time.sleep(0.0 if os.getpid() == here else DEADLINE))
    pid = copy_of(job)
    os.kill(pid, end)
    assert job.answer() is None
    assert ended(pid)


def test_a_copy_that_waits_for_what_never_comes_is_given_up(two_cores, monkeypatch):
    monkeypatch.setattr(background, "PATIENCE", 0.3)
    here = os.getpid()

    def work() -> int:
        if os.getpid() != here:
            time.sleep(DEADLINE)
        return os.getpid()

    start = time.monotonic()
    assert begun(work).answer() == here
    assert time.monotonic() - start < DEADLINE / 2.0


def test_a_copy_that_computes_is_waited_for_however_long_it_takes(two_cores, monkeypatch):
    monkeypatch.setattr(background, "PATIENCE", 0.3)

    def work() -> int:
        end = time.process_time() + 1.5
        while time.process_time() < end:
            pass
        return os.getpid()

    assert begun(work).answer() != os.getpid()


def test_what_is_stopped_ends_at_once_and_may_be_asked_for_later(two_cores):
    here = os.getpid()
    job = begun(lambda: time.sleep(0.0 if os.getpid() == here else DEADLINE) or os.getpid())
    pid = copy_of(job)
    start = time.monotonic()
    job.stop()
    assert time.monotonic() - start < DEADLINE / 2.0
    assert ended(pid)
    assert job.answer() == here


def test_ctrl_c_is_for_the_first_process_alone(two_cores):
    def work() -> int:
        os.kill(os.getpid(), signal.SIGINT)
        return os.getpid()

    assert begun(work).answer() != os.getpid()


def test_a_copy_has_pieces_done_by_threads_of_its_own(two_cores):
    squares = lambda: threads.side_by_side(lambda k: k * k, range(8))
    assert squares() == begun(squares).answer()


def test_a_copy_prints_nothing_and_its_warnings_are_not_seen(two_cores, capfd):
    def work() -> int:
        print("printed")
        warnings.warn("warned", stacklevel=1)
        os.write(2, b"written")
        return os.getpid()

    assert begun(work).answer() != os.getpid()
    assert capfd.readouterr() == ("", "")


def test_an_exception_from_a_handler_while_a_copy_is_ended_is_what_is_told(two_cores, monkeypatch):
    wait = os.waitpid

    def interrupted(*which):
        monkeypatch.setattr(os, "waitpid", wait)
        wait(*which)
        raise KeyboardInterrupt

    job = BackgroundResult(os.getpid)
    monkeypatch.setattr(os, "waitpid", interrupted)
    with pytest.raises(KeyboardInterrupt), job.ahead():
        job.answer()


def test_a_copy_calls_no_handlers_of_the_users(two_cores):
    calls, here = [], os.getpid()
    before = signal.signal(signal.SIGUSR1, lambda *_: calls.append(os.getpid()))

    def work() -> list[int]:
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGUSR1)
        return calls

    try:
        assert begun(work).answer() == []
    finally:
        signal.signal(signal.SIGUSR1, before)


def said_by(script: str) -> list[str]:
    """What a process prints that runs ``script`` on two cores."""
    start = "import os, signal, sys, torch\nfrom ocp_torch.compute import background, threads\n"
    start += "torch.set_num_threads(1)\nthreads.cores = lambda: 2 - threads.taken\nfork = os.fork\n"
    command = [sys.executable, "-c", start + script]
    return subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE, check=True).stdout.split()


def test_a_signal_that_comes_as_a_copy_begins_does_not_let_it_go_on_as_its_parent():
    script = """
def early():
    pid = fork()
    if not pid:
        os.kill(os.getpid(), signal.SIGINT)
    return pid
os.fork = early
job = background.BackgroundResult(os.getpid)
try:
    job.begin()
except KeyboardInterrupt:
    print("left", flush=True)
else:
    print(job.answer() != os.getpid(), flush=True)
"""
    assert said_by(script) == ["True"]


def test_where_standard_streams_are_closed_a_copy_answers():
    script = """
os.close(0)
os.close(2)
job = background.BackgroundResult(os.getpid)
job.begin()
print(job.answer() != os.getpid(), flush=True)
"""
    assert said_by(script) == ["True"]


SCRIPT = """
import os, time, torch
from ocp_torch.compute import threads
from ocp_torch.compute.background import BackgroundResult
torch.set_num_threads(1)
threads.cores = lambda: 2
job = BackgroundResult(lambda: time.sleep(60.0))
job.begin()
print(job._copy.pid, flush=True)
time.sleep(60.0)
"""


def test_a_copy_dies_with_the_process_that_began_it():
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        assert not ended(pid)
        process.kill()
    end = time.monotonic() + DEADLINE / 2.0
    while not ended(pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert ended(pid)
