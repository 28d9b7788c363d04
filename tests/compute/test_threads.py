"""Pieces on several cores: the results of one, in their order, and errors for whoever asked."""

import threading

import pytest
import torch

from ocp_torch.compute import threads as cores
from ocp_torch.compute.threads import CHUNK, in_pieces, parted, side_by_side


@pytest.mark.parametrize(("count", "together"), [(1, True), (2, True), (4, True), (4, False)])
def test_results_are_in_order_and_threads_are_those_that_are_allowed(monkeypatch, count, together):
    monkeypatch.setattr(cores, "cores", lambda: count)
    barrier = threading.Barrier(count if together else 1, timeout=60.0)

    def work(k):
        if k < barrier.parties:
            barrier.wait()  # passed by so many at once alone
        return k, threading.current_thread()

    found = side_by_side(work, list(range(7)), together)
    assert [k for k, _ in found] == list(range(7))
    threads = {thread for _, thread in found}
    assert len(threads) == (count if together else 1)
    assert threading.current_thread() in threads


def test_a_sum_in_a_thread_is_bitwise_that_of_whoever_asked(monkeypatch):
    # A product of large matrices is summed by so many threads as PyTorch may take, in an order of their number.
    left, right = torch.randn(2, 2048, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    sums = []
    for count in (1, 2):
        monkeypatch.setattr(cores, "cores", lambda count=count: count)
        sums.append(side_by_side(lambda k: left.T @ right, [0, 1]))
    assert all(torch.equal(one, other) for one in sums[0] for other in sums[1])


@pytest.mark.parametrize("together", [True, False])
def test_an_error_in_a_piece_reaches_whoever_asked(monkeypatch, together):
    monkeypatch.setattr(cores, "cores", lambda: 2)

    def work(k):
        if k == 1:
            raise ArithmeticError("piece 1")
        return k

    with pytest.raises(ArithmeticError, match="piece 1"):
        side_by_side(work, [0, 1, 2], together)


def test_cores_that_are_taken_meanwhile_do_no_harm(monkeypatch):
    left = iter([2])
    monkeypatch.setattr(cores, "cores", lambda: next(left, 1))
    assert side_by_side(lambda k: k * k, range(4)) == [0, 1, 4, 9]


def test_of_several_errors_it_is_the_first_that_is_told(monkeypatch):
    monkeypatch.setattr(cores, "cores", lambda: 2)
    later = threading.Event()

    def work(k):
        if k == 1:
            later.set()
        else:
            later.wait(timeout=60.0)  # until the other has failed, or is about to
        raise ArithmeticError(f"piece {k}")

    with pytest.raises(ArithmeticError, match="piece 0"):
        side_by_side(work, [0, 1])


@pytest.mark.parametrize("size", [1, 7, CHUNK])
@pytest.mark.parametrize("count", [0, 1, 6, 7, 8, 100, 2624])
def test_parts_are_even_and_not_too_large(count, size):
    sizes = parted(count, size)
    assert sum(sizes) == count
    assert max(sizes) <= size
    assert max(sizes) - min(sizes) <= 1
    assert len(sizes) == 1 or len(sizes) % 2 == 0


@pytest.mark.parametrize("count", [1, CHUNK, 2 * CHUNK + 3])
def test_rows_come_back_where_they_were(monkeypatch, count):
    monkeypatch.setattr(cores, "cores", lambda: 3)
    first, second = in_pieces(lambda rows: (2 * rows, rows.unsqueeze(-1)), torch.arange(count), together=True)
    assert torch.equal(first, 2 * torch.arange(count))
    assert torch.equal(second, torch.arange(count).unsqueeze(-1))
