"""Export of a function of the state to files that need no PyTorch, with a description and its origin inside."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from ocp_torch.errors import InputError, require_choice
from ocp_torch.export.c_source import c_source
from ocp_torch.export.casadi_function import casadi_function, require_casadi
from ocp_torch.export.lowering import lowered
from ocp_torch.export.onnx_model import onnx_model
from ocp_torch.export.program import Program
from ocp_torch.files.storage import write_atomically

# The output for which the C source has a function of its own.
CONTROL = "control"


def export(
    function: Callable[[Tensor], dict[str, Tensor]],
    examples: Tensor,
    out: Path,
    format: str | None,
    about: str,
    metadata: dict,
) -> list[Path]:
    """Write ``function``, of states ``(N, d)`` to a batch for each name, to ``out``, and return the files.

    The function is traced on the first of ``examples`` ``(K, d)``, float64, and checked at the others. ``format`` is one of
    `FORMATS`, by default by the suffix of ``out``. ``about`` is a text for readers, ``metadata`` goes inside as JSON. Raises
    `InputError` for a wrong choice, a library that is missing, and a function that cannot be traced.
    """
    known = [name for name, (ending, _) in FORMATS.items() if out.suffix == ending]
    if format is None and not known:
        endings = ", ".join(ending for ending, _ in FORMATS.values())
        raise InputError(f"out is {str(out)!r}, but must end in one of {endings}, unless format names one.")
    chosen = known[0] if format is None else require_choice("format", format, FORMATS)
    ending, write = FORMATS[chosen]
    if out.suffix != ending:
        raise InputError(f"out is {str(out)!r}, but format={chosen} writes files that end in {ending}.")
    name = out.stem
    if not (name.isascii() and name.isidentifier()):
        raise InputError(f"out is {str(out)!r}, but its name must be letters, digits and _, as functions bear it.")
    return write(lowered(function, examples), out, about, metadata)


def _onnx(program: Program, out: Path, about: str, metadata: dict) -> list[Path]:
    model = onnx_model(program, out.stem, about, metadata)
    write_atomically(out, lambda path: path.write_bytes(model.SerializeToString()))
    return [out]


def _c(program: Program, out: Path, about: str, metadata: dict) -> list[Path]:
    rest = {key: view for key, view in program.outputs.items() if key != CONTROL}
    functions = {"control": replace(program, outputs={CONTROL: program.outputs[CONTROL]}).pruned()}
    if rest:
        functions["value"] = replace(program, outputs=rest).pruned()
    header, source = c_source(functions, out.stem, about, metadata)
    files = {out.with_suffix(".h"): header, out: source}
    for file, text in files.items():
        write_atomically(file, lambda path, text=text: path.write_text(text, encoding="utf-8"))  # type: ignore[misc]
    return list(files)


def _casadi(program: Program, out: Path, about: str, metadata: dict) -> list[Path]:
    casadi, function = require_casadi(), casadi_function(program, out.stem)

    def write(path: Path) -> None:
        file = casadi.FileSerializer(str(path))
        file.pack(function)  # `casadi.Function.load` reads this, and `casadi.FileDeserializer` what follows
        file.pack(json.dumps({"about": about, **metadata}))
        del file  # closes it

    write_atomically(out, write)
    return [out]


# Format -> suffix of its files, and the function that writes them.
FORMATS: dict[str, tuple[str, Callable[[Program, Path, str, dict], Any]]] = {
    "onnx": (".onnx", _onnx),
    "c": (".c", _c),
    "casadi": (".casadi", _casadi),
}
