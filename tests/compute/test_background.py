"""Work begun in a thread: the same answer, errors for whoever asks, and an end when nobody wants it any more."""

import threading
import time

import pytest
import torch

from ocp_torch.compute import background as ahead
from ocp_torch.compute.background import BackgroundResult

DEADLINE = 60.0


def counting(count: int, done: list, gate: threading.Event | None = None):
    for k in range(count):
        if gate is not None:
            gate.wait(DEADLINE)
        done.append((k, threading.current_thread()))
        yield
    return sum(k for k, _ in done)


@pytest.mark.parametrize("count", [1, 2])
def test_the_answer_is_that_of_the_work_wherever_it_is_done(monkeypatch, count):
    monkeypatch.setattr(ahead, "cores", lambda: count)
    done: list = []
    work = BackgroundResult(counting(5, done))
    work.begin()
    assert work.answer() == work.answer() == 10
    threads = {thread for _, thread in done}
    assert (threading.current_thread() in threads) == (count == 1)
    assert len(threads) == 1


def test_a_sum_begun_before_is_bitwise_that_of_whoever_asked(monkeypatch):
    left, right = torch.randn(2, 2048, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def product():
        yield
        return left.T @ right

    monkeypatch.setattr(ahead, "cores", lambda: 2)
    work = BackgroundResult(product())
    work.begin()
    assert torch.equal(work.answer(), left.T @ right)


def test_without_a_beginning_whoever_asks_does_the_work():
    done: list = []
    assert BackgroundResult(counting(3, done)).answer() == 3
    assert {thread for _, thread in done} == {threading.current_thread()}


def test_an_error_reaches_whoever_asks(monkeypatch):
    monkeypatch.setattr(ahead, "cores", lambda: 2)

    def failing():
        yield
        raise ArithmeticError("no number")

    work = BackgroundResult(failing())
    work.begin()
    for _ in range(2):
        with pytest.raises(ArithmeticError, match="no number"):
            work.answer()


def test_what_is_stopped_ends_after_its_piece_and_may_be_asked_for_later(monkeypatch):
    monkeypatch.setattr(ahead, "cores", lambda: 2)
    done: list = []
    gate = threading.Event()
    work = BackgroundResult(counting(1000, done, gate))
    work.begin()
    opener = threading.Timer(0.05, gate.set)
    opener.start()
    start = time.monotonic()
    work.stop()
    assert time.monotonic() - start < DEADLINE
    assert len(done) < 1000
    assert not any(thread.name == "ocp_torch ahead" for thread in threading.enumerate())
    assert work.answer() == sum(range(1000))
