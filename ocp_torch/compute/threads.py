"""Work in pieces, on as many cores as there are, and on other processes of the run where these wait. The pieces do not depend
on any of that, and so neither do the results.

PyTorch's own threads wait for one another in a loop: of two processes with two of them on two cores each took three times as
long as with one. Threads of Python wait without working, and give up their lock while PyTorch computes.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache, partial
from typing import TypeVar

import torch
from torch import Tensor

from ocp_torch.compute.processes import here

T = TypeVar("T")
S = TypeVar("S")

# States evaluated at once: what fits the cache is fastest.
CHUNK = 1024


taken = 0  # cores that copies of this process use now


def cores() -> int:
    """The number of cores that this process may use, beside copies of it and others of its run on this machine."""
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, there // here().busy - taken)


def alone(own: int) -> None:
    """Begin anew in a copy of a process, which has none of its threads, on so many cores of its ``own``."""
    global taken
    taken += cores() - own
    _helpers.cache_clear()


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    """``count`` threads that wait for pieces: to start new ones for each call would take a millisecond and a half."""
    return ThreadPoolExecutor(count, thread_name_prefix="ocp_torch pieces")


def side_by_side(function: Callable[[T], S], pieces: Sequence[T], together: bool = True) -> list[S]:
    """``function`` of each of ``pieces``: ``together``, for which it must be pure, or one after the other.

    The calling thread takes pieces too, so that it never waits for threads that other callers keep busy.
    """
    free = cores()  # asked for once: a copy that another thread begins may take some meanwhile
    count = min(free, len(pieces)) - 1 if together else 0
    if count < 1:
        return [function(piece) for piece in pieces]
    left, found, failed = iter(list(enumerate(pieces))), dict[int, S](), dict[int, BaseException]()
    threads = torch.get_num_threads()

    def work() -> None:
        # A thread would take as many of PyTorch's as there are cores, not as are set: slower, and sums in another order.
        if torch.get_num_threads() != threads:
            torch.set_num_threads(threads)
        for k, piece in left:  # each thread that is free takes the next
            try:
                found[k] = function(piece)
            except BaseException as error:  # raised in the calling thread
                failed[k] = error
                return

    helping = [_helpers(free - 1).submit(work) for _ in range(count)]
    work()
    wait([helper for helper in helping if not helper.cancel()])
    if failed:  # of several the one that a single core would meet: all pieces before it were taken before it
        raise failed[min(failed)]
    return [found[k] for k in range(len(pieces))]


def spread(function: Callable[[T], S], pieces: Sequence[T], together: bool = True) -> list[S]:
    """`side_by_side`, on other processes of the run that wait as well: for what takes longer than the way there and back."""
    return (
        here().spread(partial(side_by_side, function), pieces) if together else side_by_side(function, pieces, together)
    )


def parted(count: int, size: int = CHUNK) -> list[int]:
    """The sizes of an even number of pieces of ``count`` rows, as equal as can be and at most ``size``, for two cores to have
    the same to do; a single one where all fit."""
    if count <= size:
        return [count]
    pieces = 2 * math.ceil(count / (2 * size))
    return [count // pieces + (k < count % pieces) for k in range(pieces)]


def in_pieces(
    function: Callable[[Tensor], tuple[Tensor, ...]],
    rows: Tensor,
    together: bool,
    size: int = CHUNK,
    long: bool = False,
) -> tuple[Tensor, ...]:
    """The tensors ``function(rows)``, of a row for each of ``rows``: ``together`` from pieces of ``size``, or all at once.
    Pieces that take ``long`` are `spread`."""
    if not together:
        return function(rows)
    found = (spread if long else side_by_side)(function, rows.split(parted(len(rows), size)))
    return tuple(torch.cat(parts) for parts in zip(*found, strict=True))
