"""A reference as one NPZ file, which loads without pickle."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ocp_torch.errors import InputError
from ocp_torch.files.reading import FOLDER, kind
from ocp_torch.files.storage import write_atomically
from ocp_torch.studies.reference.reference import Reference


def require_npz(name: str, value: object) -> Path:
    """``value`` as the path of an NPZ file that can be written; raise `InputError` otherwise."""
    path = Path(str(value))
    if path.suffix != ".npz" or kind(path) == FOLDER:
        raise InputError(f"{name} is {str(value)!r}, but must be a file whose name ends in .npz.")
    if kind(path.parent) not in (FOLDER, None):
        raise InputError(f"{name} is {str(value)!r}, but {path.parent} is not a folder.")
    return path


def save_reference(path: Path, reference: Reference) -> None:
    """Write ``optimum``, ``error`` (NaN where it is unknown), ``order``, ``sides``, ``estimates``, and of the finest grid
    ``value`` ``(side,) * d`` and ``control`` ``(side,) * d + (m,)``, at the nodes `k / side`."""
    arrays = {
        "optimum": np.float64(reference.optimum),
        "error": np.float64(np.nan if reference.error is None else reference.error),
        "order": np.float64(reference.order),
        "sides": np.array(reference.sides),
        "estimates": np.array(reference.estimates),
        "value": reference.value.numpy(),
        "control": reference.control.numpy(),
    }

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_atomically(path, write)
