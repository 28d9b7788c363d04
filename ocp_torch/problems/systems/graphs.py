"""Adjacency matrices of coupled oscillators: by name, by seed, from a list of rows or from a file."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ocp_torch.errors import InputError, nearest, require_numbers
from ocp_torch.files.arrays import read_npy
from ocp_torch.files.reading import read_text

GRAPHS = ("complete", "ring", "random")
SUFFIXES = (".npy", ".txt")
# Characters of a number in a text file, on average, at most.
LONGEST_NUMBER = 64
# A file of up to so many bytes is read even if it is larger than it should be, so that an error can state its shape.
LEAST_ROOM = 2**20


def adjacency(name: str, value: object, count: int, probability: float, seed: int) -> Tensor:
    """The weights `A_ij >= 0` of the action of `j` on `i`, ``(count, count)`` float64 with zero diagonal.

    ``value`` is complete, ring, random (a random tree, and each other edge with ``probability``, drawn by ``seed``: always
    connected), a `.npy` or `.txt` file, or a list of rows. Raises `InputError` for anything else, or one of another size.
    """
    if not isinstance(value, str):
        if not isinstance(value, Sequence) or len(value) != count:
            raise InputError(f"{name} is {value!r}, but must be a list of {count} rows.")
        rows = [require_numbers(f"{name}[{i}]", row, count) for i, row in enumerate(value)]
        return _checked(name, np.array(rows), count)
    if Path(value).suffix in SUFFIXES:
        return _checked(name, _read(name, Path(value), count), count)
    own = torch.eye(count, dtype=torch.float64)
    if value == "complete":
        return 1.0 - own
    if value == "ring":
        return torch.maximum(own.roll(1, dims=0), own.roll(-1, dims=0))
    if value == "random":
        return _random(count, probability, seed)
    raise InputError(
        f"{name} is {value!r}, but must be {', '.join(GRAPHS)}, a .npy or .txt file, or a list of rows"
        f"{nearest(value, GRAPHS)}."
    )


def _random(count: int, probability: float, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(count, count, generator=generator, dtype=torch.float64).triu(1) + torch.ones(count, count).tril()
    A = (drawn < probability).double()
    order = torch.randperm(count, generator=generator).tolist()
    for k in range(1, count):
        i, j = order[k], order[int(torch.randint(k, (), generator=generator))]
        A[i, j] = 1.0
    return torch.maximum(A, A.T)


def _read(name: str, path: Path, count: int) -> np.ndarray:
    try:
        if path.suffix == ".npy":
            return read_npy(path, max(8 * count**2, LEAST_ROOM))
        text = read_text(path, LONGEST_NUMBER * count**2)
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy only warns of an empty file
            return np.loadtxt(text.splitlines(), ndmin=2)
    except InputError as error:
        raise InputError(f"{name} cannot be read: {error}") from None
    except (ValueError, EOFError, UserWarning) as error:
        raise InputError(f"{name} = {path} is not a matrix of numbers ({error}).") from None


def _checked(name: str, matrix: np.ndarray, count: int) -> Tensor:
    if matrix.shape != (count, count) or matrix.dtype.kind not in "buif":
        raise InputError(f"{name} has shape {matrix.shape}, but must be a {count} by {count} matrix of numbers.")
    A = torch.from_numpy(np.array(matrix, dtype=np.float64))
    if not bool(torch.isfinite(A).all()) or bool((A < 0.0).any()):
        raise InputError(f"{name} holds a weight that is negative or not finite; every weight must be at least 0.")
    if bool(A.diagonal().any()):
        raise InputError(f"{name} has a weight on its diagonal, but an oscillator does not act on itself.")
    return A
