"""Controllers by what the command line names: a function in a file, a run of ours, ONNX, TorchScript."""

import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path

import torch

from ocp_torch.control.controller import Controller
from ocp_torch.control.described import problem_name
from ocp_torch.control.saved import controller_file, load_controller
from ocp_torch.errors import InputError, first_line
from ocp_torch.files.reading import FOLDER, kind, require_file
from ocp_torch.problems import PROBLEMS, Problem
from ocp_torch.problems.simulator.target import resolved
from ocp_torch.runs.onnx_controller import onnx_controller

log = logging.getLogger(__name__)


def load_policy(source: str, problem: Problem) -> Callable | Controller:
    """The controller the command line names: FILE.py:function, a run's folder or a file of ours, .onnx, or TorchScript.

    A .py file is code, and so is TorchScript, which can write files by itself: name only trusted ones here. An .onnx file,
    like one of ours, can only compute.
    """
    if str(source).rpartition(":")[0].endswith(".py"):
        return resolved(str(source), "controller")
    path = Path(str(source))
    if path.suffix == ".py":
        raise InputError(f"controller is {source!r}, but must name its function, as in {source}:function.")
    found = kind(path)
    if found is None:
        raise InputError(
            f"controller is {str(source)!r}, which does not exist; give FILE.py:function, a run's folder, a "
            "controller.safetensors, an .onnx or, if you trust it with your files, a TorchScript file."
        )
    if found == FOLDER or path.suffix == ".safetensors":
        return load_saved(path, problem)
    require_file(path)
    return onnx_controller(path, problem) if path.suffix == ".onnx" else _torchscript(path)


def load_saved(path: Path, problem: Problem) -> Controller:
    """A controller of ours, by its file or its run's folder. A user's own ``problem`` is given to it; a problem of the
    package is the file's, of the class of ``problem``, else `InputError`."""
    file = controller_file(path)
    if problem_name(problem) not in PROBLEMS:
        return load_controller(file, problem=problem)
    found = load_controller(file)
    if type(found.problem) is not type(problem):
        raise InputError(f"{file} belongs to {problem_name(found.problem)!r}, not to {problem_name(problem)!r}.")
    return found


def _torchscript(path: Path) -> Callable:
    _warn_of_code(path)
    try:
        return torch.jit.load(str(path), map_location="cpu").eval()
    except Exception as error:  # the loader has no one type for a bad file
        raise InputError(f"{path} is not a TorchScript file ({first_line(error).split('. ')[0]}).") from None


@cache
def _warn_of_code(path: Path) -> None:
    """Log a warning, once, that TorchScript can write files."""
    said = "warning: %s is TorchScript, code that can write your files; load it if you trust it, or take ONNX."
    log.warning(said, path)
