"""A controller in an ONNX file as a function of states of the torus: a user's own, or one that was exported here."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ocp_torch.control.exported import PHYSICAL
from ocp_torch.errors import InputError, first_line, shown
from ocp_torch.export import CONTROL
from ocp_torch.files.plain import NotPlain, json_object
from ocp_torch.problems import Problem
from ocp_torch.problems.physical.system import System

PRECISIONS = {"tensor(double)": torch.float64, "tensor(float)": torch.float32}
# Key of the metadata of an exported controller.
KEY = "ocp_torch"


def onnx_controller(path: Path, problem: Problem) -> Callable[[Tensor], Tensor]:
    """The model in ``path`` as a function of states ``(N, d)`` of the torus to controls ``(N, m)``; physical units of an
    exported model are converted. Raises `InputError` for a file that holds no such function."""
    try:
        import onnxruntime
    except ImportError:
        raise InputError(f"{path} needs onnxruntime: pip install onnxruntime.") from None
    try:
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    except Exception as error:  # the runtime has no one type for a bad file
        raise InputError(f"{path} is not a model that onnxruntime can run: {first_line(error)}.") from None
    given, precision, output = *_input(session, path, problem.dim), _output(session, path)

    def model(x: Tensor) -> Tensor:
        return torch.from_numpy(session.run([output], {given: x.to(precision).numpy()})[0])

    if not _physical(session):
        return model
    if not isinstance(problem, System):
        raise InputError(
            f"{path} is in physical units, which the problem does not have; export with coordinates=torus."
        )
    return lambda x: problem.to_controls(model(problem.from_torus(x)))


def _input(session: Any, path: Path, dim: int) -> tuple[str, torch.dtype]:
    """Name and precision of the one input, which must take any number of states."""
    inputs = session.get_inputs()
    if len(inputs) != 1:
        raise InputError(f"{path} has the inputs {_names(inputs)}, but must have one, states (N, {dim}).")
    (entry,) = inputs
    if entry.type not in PRECISIONS:
        raise InputError(f"{path} takes {entry.type}, but must take {' or '.join(PRECISIONS)}.")
    shape = list(entry.shape)
    fits = len(shape) == 2 and not isinstance(shape[0], int) and not (isinstance(shape[1], int) and shape[1] != dim)
    if shape and not fits:
        raise InputError(
            f"{path} takes states of shape {shown(tuple(shape))}, but must take (N, {dim}), with N free (dynamic_axes or "
            "dynamic_shapes of torch.onnx.export)."
        )
    return entry.name, PRECISIONS[entry.type]


def _output(session: Any, path: Path) -> str:
    """The name of the control among the outputs."""
    outputs = session.get_outputs()
    called = [output for output in outputs if output.name == CONTROL]
    if len(outputs) > 1 and not called:
        raise InputError(f"{path} has the outputs {_names(outputs)}; which is the control? Call it {CONTROL}.")
    entry = (called or outputs)[0]
    if entry.type not in PRECISIONS:
        raise InputError(f"{path} gives {entry.type}, but must give {' or '.join(PRECISIONS)}.")
    return entry.name


def _names(entries: Any) -> str:
    return shown([entry.name for entry in entries])


def _physical(session: Any) -> bool:
    """Whether the file says that it was exported in physical units."""
    try:
        kept = json_object(session.get_modelmeta().custom_metadata_map.get(KEY, "{}"))
    except NotPlain:  # metadata of another program
        return False
    return kept.get("coordinates") == PHYSICAL
