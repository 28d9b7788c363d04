"""Command lines of every script in this process, up to where the work would begin: for tests that try hundreds of them."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from unittest import mock

import torch

from ocp_torch.cli import launch as launching
from ocp_torch.cli.outcome import fail
from ocp_torch.errors import InputError

# What takes one of Hydra's configurations, as a command beside `compare`.
CHECKED = ("train", "certify", "evaluate", "reference", "record", "rollout", "benchmark", "reproduce_paper")


def command(name: str):
    """The module behind `scripts/<name>.py`."""
    return importlib.import_module(f"ocp_torch.cli.commands.{name}")


def entered(name: str, *arguments: str) -> tuple[int, str, str]:
    """Exit status and output of `scripts/<name>.py` with ``arguments``, where the work itself would only say so."""
    out, err = io.StringIO(), io.StringIO()
    argv, path = sys.argv, list(sys.path)
    sys.argv = [f"{name}.py", *arguments]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            if name == "compare":
                try:
                    command(name).compared(list(arguments))
                except InputError as error:
                    fail(str(error))
            else:
                with mock.patch.object(launching, "carry_out", side_effect=lambda *_: print("begun")):
                    launching.launch(lambda: print("begun"), name, command(name).main.check, print)
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
