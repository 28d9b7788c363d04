"""Work in pieces, on as many cores as there are. The pieces do not depend on these, and so neither do the results.

PyTorch's own threads wait for one another in a loop: of two processes with two of them on two cores each took three times as
long as with one. Threads of Python wait without working, and give up their lock while PyTorch computes.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch
from torch import Tensor

T = TypeVar("T")
S = TypeVar("S")

# States evaluated at once: what fits the cache is fastest.
CHUNK = 1024


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def side_by_side(function: Callable[[T], S], pieces: Sequence[T], together: bool = True) -> list[S]:
    """``function`` of each of ``pieces``: ``together``, for which it must be pure, or one after the other."""
    threads = min(cores(), len(pieces)) if together else 1
    if threads < 2:
        return [function(piece) for piece in pieces]
    # A thread would take as many of PyTorch's as there are cores, not as many as are set: slower, and sums in another order.
    with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(torch.get_num_threads(),)) as pool:
        return list(pool.map(function, pieces))


def in_pieces(
    function: Callable[[Tensor], tuple[Tensor, ...]], rows: Tensor, together: bool, size: int = CHUNK
) -> tuple[Tensor, ...]:
    """The tensors ``function(rows)``, of a row for each of ``rows``: ``together`` from pieces of ``size``, or all at once."""
    if not together:
        return function(rows)
    found = side_by_side(function, rows.split(size))
    return tuple(torch.cat(parts) for parts in zip(*found, strict=True))
