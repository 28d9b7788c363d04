"""Processes that share the batches of somebody's simulator."""

from __future__ import annotations

import multiprocessing
import os
import sys
import weakref
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

import numpy as np

from ocp_torch.errors import InputError
from ocp_torch.problems.target import asked, resolved

_function = None


def _start(target: str, path: list[str], folder: str) -> None:
    """In each process, once: the function by its name, found where the parent would find it."""
    global _function
    sys.path[:] = path
    os.chdir(folder)
    _function = resolved(target)


def _share(x: np.ndarray, one_by_one: bool):
    return asked(_function, x, one_by_one)


class Workers:
    """``count`` processes that each import ``target``; they end with this object."""

    def __init__(self, target: str, count: int) -> None:
        self.count = count
        # Not forked: a process with threads, as PyTorch has, must not be.
        context = multiprocessing.get_context("spawn")
        given = (target, list(sys.path), os.getcwd())
        self._pool = ProcessPoolExecutor(count, mp_context=context, initializer=_start, initargs=given)
        weakref.finalize(self, self._pool.shutdown, wait=False, cancel_futures=True)

    def map(self, x: np.ndarray, one_by_one: bool) -> tuple:
        """The answers at ``x``, each process with its part of the rows. Raises what the function raises."""
        parts = [part for part in np.array_split(x, self.count) if len(part)]
        try:
            answers = list(self._pool.map(_share, parts, [one_by_one] * len(parts)))
        except BrokenProcessPool:
            raise InputError("a process of problem.workers died; try problem.workers=1 to see why.") from None
        if not all(isinstance(answer, tuple | list) for answer in answers):
            return answers[0]
        return tuple(None if column[0] is None else np.concatenate(column) for column in zip(*answers, strict=True))
