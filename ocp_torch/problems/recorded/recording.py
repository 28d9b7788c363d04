"""Recorded samples of a problem as a file, NPZ or safetensors: read without running anything in it, and checked.

Arrays: ``x (N, d)`` in `[0, 1)`, ``f (N,)``, ``a (N, d)``, ``B (N, d, m)``; optionally ``div_a (N,)``, ``div_B (N, m)``,
``mu0 (N,)``, and ``density (N,)``, that of the distribution ``x`` was drawn from (uniform where it is left out). Where there
is noise ``noise (N, d, k)``, `sigma`, and optionally ``div_D (N, d)`` and ``div_div_D (N,)`` of `D = sigma sigma^T / 2`; they
are 0 where `sigma` is the same at all samples. Optionally the numbers ``discount``, ``exponent`` and ``control_limit``
(one, or one for each control); and ``units``, the bytes of a text, `Measures.plain` as JSON: names and units of coordinates
and controls. Samples must be independent draws.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save_file
from torch import Tensor

from ocp_torch.errors import InputError, nearest, visible
from ocp_torch.files.arrays import read_npz
from ocp_torch.files.plain import NotPlain, json_object
from ocp_torch.files.reading import kind
from ocp_torch.files.storage import read_safetensors, write_atomically
from ocp_torch.problems.physical.measures import Measures
from ocp_torch.problems.recorded.independence import dependence_notes, without_copies
from ocp_torch.problems.recorded.neighbours import neighbour_notes
from ocp_torch.problems.recorded.plausible import divergence_notes, samples_of
from ocp_torch.problems.samples import Samples

REQUIRED = {"x": "Nd", "f": "N", "a": "Nd", "B": "Ndm"}
OPTIONAL = {"div_a": "N", "div_B": "Nm", "mu0": "N", "density": "N", "noise": "Ndk", "div_D": "Nd", "div_div_D": "N"}
NUMBERS = ("discount", "exponent", "control_limit")
UNITS = "units"
KNOWN = (*REQUIRED, *OPTIONAL, *NUMBERS, UNITS)
SUFFIXES = (".npz", ".safetensors")
# With fewer samples their distribution cannot be checked.
FEWEST = 100
# Bytes that are read into memory at most, unpacked.
MOST_BYTES = 2**33
# Bytes of names and units at most: some two hundred for each of 1024 coordinates and 1024 controls.
MOST_UNITS = 2**19


@dataclass(frozen=True)
class Recording:
    """Samples in float64, weighted by one over the density of their law; the numbers of the file; the SHA-256 of its arrays;
    notes for the user; and names and units, where the file has some."""

    samples: Samples
    numbers: dict[str, Any]  # each a float, but a limit for each control is a list
    digest: str
    notes: tuple[str, ...] = ()
    measures: Measures | None = None


def read(path: str | Path, wrap: bool = False) -> Recording:
    """The recording in the file ``path``; with ``wrap`` states outside `[0, 1)` are taken modulo 1.

    Raises `InputError`, in one sentence, for a file that is missing, damaged or of another kind, and for arrays that are
    missing, of a wrong shape or type, not finite, or not what they are called.
    """
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(f"problem.path is {str(path)!r}, but must be a file ending in {' or '.join(SUFFIXES)}.")
    if kind(path) is None:
        raise InputError(f"problem.path is {str(path)!r}, which does not exist.")
    arrays = read_npz(path, KNOWN, MOST_BYTES) if path.suffix == ".npz" else _read_safetensors(path)
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}; a recording holds x, f, a and B.")
    for name in arrays:
        if name not in KNOWN:
            raise InputError(f"{path} holds {name!r}, which is no array of a recording{nearest(name, KNOWN)}.")
    numbers: dict[str, Any] = {}
    for name in (name for name in NUMBERS if name in arrays):
        number = arrays.pop(name)
        each = name == "control_limit" and number.shape == arrays["B"].shape[2:]
        if not (each or number.size == 1) or not np.isfinite(number).all():
            wanted = "one finite number" + (", or one for each control" if name == "control_limit" else "")
            raise InputError(f"{path}: {name} has shape {number.shape}, but must be {wanted}.")
        numbers[name] = float(number.reshape(())) if number.size == 1 else number.tolist()
    units = arrays.pop(UNITS, None)
    _require_shapes(path, arrays)
    for name, array in arrays.items():
        bad = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
        if bad.any():
            raise InputError(f"{path}: {name} is not finite at {int(bad.sum())} samples, first at row {bad.argmax()}.")
    samples = samples_of(path, arrays, wrap)
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).data)
    measures, of_units = (None, ()) if units is None else _measures(path, units, *samples.B.shape[1:])
    kept = without_copies(samples)
    notes = divergence_notes(path, kept) + neighbour_notes(path, kept) + dependence_notes(path, kept) + of_units
    if copies := len(samples) - len(kept):
        notes = (f"{copies:,} samples of {path.name} are at the state of another, and are left out.", *notes)
    return Recording(kept, numbers, digest.hexdigest(), notes, measures)


def _measures(path: Path, units: np.ndarray, dim: int, control_dim: int) -> tuple[Measures | None, tuple[str, ...]]:
    """Names and units of a file; or `None` and a note where they are damaged, as they are labels only."""
    try:
        if units.ndim != 1 or units.size > MOST_UNITS or not ((units >= 0) & (units < 256)).all():
            raise NotPlain("it is no text")
        return Measures.of(json_object(units.astype(np.uint8).tobytes().decode()), dim, control_dim), ()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        return None, (
            f"names and units of {path.name} cannot be read ({visible(error, 200).rstrip('.')}), and are left out.",
        )


def write(
    path: str | Path,
    samples: Samples,
    numbers: dict[str, Any],
    density: Tensor | None = None,
    measures: Measures | None = None,
) -> None:
    """Write ``samples`` for `read`; ``density`` ``(N,)`` is that of the distribution of ``x``, uniform if `None`."""
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(f"out is {str(path)!r}, but must be a file ending in {' or '.join(SUFFIXES)}.")
    columns = {name: getattr(samples, name) for name in (*REQUIRED, *OPTIONAL) if name != "density"}
    columns["density"] = density
    arrays = {k: np.ascontiguousarray(v.detach().cpu().numpy()) for k, v in columns.items() if v is not None}
    arrays |= {k: np.asarray(v, dtype=np.float64) for k, v in numbers.items() if v is not None}
    if measures is not None:
        arrays[UNITS] = np.frombuffer(json.dumps(measures.plain).encode(), dtype=np.uint8)

    def fill(temporary: Path) -> None:
        if path.suffix == ".safetensors":
            save_file(arrays, str(temporary))
            return
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    write_atomically(path, fill)


def _read_safetensors(path: Path) -> dict[str, np.ndarray]:
    tensors, _ = read_safetensors(path, MOST_BYTES)
    for name, tensor in tensors.items():
        if tensor.dtype == torch.bool or tensor.is_complex():
            kind_of = str(tensor.dtype).removeprefix("torch.")
            raise InputError(f"{path}: {name} has type {kind_of}, but must hold real numbers.")
    total = 8 * sum(tensor.numel() for tensor in tensors.values())
    if total > MOST_BYTES:
        raise InputError(f"{path} unpacks to {total:,} bytes, but at most {MOST_BYTES:,} are read.")
    return {name: tensor.double().numpy() for name, tensor in tensors.items()}


def _require_shapes(path: Path, arrays: dict[str, np.ndarray]) -> None:
    x, B = arrays["x"], arrays["B"]
    if x.ndim != 2 or x.shape[1] < 1 or B.ndim != 3 or B.shape[2] < 1:
        raise InputError(f"{path}: x has shape {x.shape} and B {B.shape}, but they must have (N, d) and (N, d, m).")
    sigma = arrays.get("noise", x[:, :, None])
    if sigma.ndim != 3 or sigma.shape[2] < 1:
        raise InputError(f"{path}: noise has shape {sigma.shape}, but must have (N, d, k).")
    missing = [name for name in ("noise", "div_D", "div_div_D") if name not in arrays]
    if "noise" in missing and len(missing) < 3 or len(missing) == 1:
        together = "div_D and div_div_D go with each other and with noise, of which they are the divergences"
        raise InputError(f"{path} lacks {', '.join(missing)}; {together}.")
    sizes = {"N": len(x), "d": x.shape[1], "m": B.shape[2], "k": sigma.shape[2]}
    for name, form in {**REQUIRED, **OPTIONAL}.items():
        expected = tuple(sizes[letter] for letter in form)
        if name in arrays and arrays[name].shape != expected:
            letters = ", ".join(form) + ("," if len(form) == 1 else "")
            raise InputError(f"{path}: {name} has shape {arrays[name].shape}, but must have ({letters}) = {expected}.")
    if len(x) < FEWEST:
        raise InputError(f"{path} holds {len(x)} samples, but at least {FEWEST} are needed.")
