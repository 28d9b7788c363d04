"""Command lines of every script in this process, up to where the work would begin: for tests that try hundreds of them."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import sys
from functools import cache
from unittest import mock

import torch

from ocp_torch.cli import launch as launching
from ocp_torch.cli.launch import CHECKOUT, fail
from ocp_torch.errors import InputError

# Script -> the name of its check, where it has one of Hydra's configurations.
CHECKS = {
    "train": "training_run",
    "certify": "arguments",
    "evaluate": "recertification",
    "reference": "ReferenceJob",
    "record": "arguments",
    "rollout": "RolloutJob",
    "benchmark": "Contest",
    "reproduce_paper": "check",
}


@cache
def script(name: str):
    """The module of `scripts/<name>.py`."""
    spec = importlib.util.spec_from_file_location(f"script_{name}", CHECKOUT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def entered(name: str, *arguments: str) -> tuple[int, str, str]:
    """Exit status and output of `scripts/<name>.py` with ``arguments``, where the work itself would only say so."""
    out, err = io.StringIO(), io.StringIO()
    argv, path = sys.argv, list(sys.path)
    sys.argv = [f"{name}.py", *arguments]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            if name == "compare":
                try:
                    script(name).main(list(arguments))
                except InputError as error:
                    fail(str(error))
            else:
                with mock.patch.object(launching, "carry_out", side_effect=lambda *_: print("begun")):
                    launching.launch(lambda: print("begun"), name, getattr(script(name), CHECKS[name]), print)
        return 0, out.getvalue(), err.getvalue()
    except SystemExit as end:
        return end.code, out.getvalue(), err.getvalue()
    finally:
        sys.argv, sys.path[:] = argv, path
        torch.set_num_threads(1)


def leaves(node: dict, prefix: str = "") -> list[str]:
    return [
        name
        for key, value in node.items()
        for name in (leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else [f"{prefix}{key}"])
    ]
