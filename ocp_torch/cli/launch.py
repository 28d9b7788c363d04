"""The way in: a command is checked before anything is written, and whatever is wrong with it is told in one sentence."""

import logging
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch.optim import Optimizer

from ocp_torch.cli.compose import composed, parsed, register_resolvers, with_own_defaults
from ocp_torch.cli.explain import CHECKOUT, CONFIGS, known_fields
from ocp_torch.cli.job import isolated, job
from ocp_torch.cli.outcome import INTERRUPTED, Record, fail, failures
from ocp_torch.cli.single import carry_out, checked, require_places_to_write
from ocp_torch.cli.sweeps import check_sweep
from ocp_torch.errors import InputError
from ocp_torch.files.reading import require_unlinked
from ocp_torch.problems.commands import ForeignProblem
from ocp_torch.training.signals import Preempted

__all__ = ["CHECKOUT", "CONFIGS", "composed", "fail", "isolated", "job", "known_fields", "launch", "register_resolvers"]

ASKS = ("--help", "-h", "--info", "-i", "--cfg", "-c", "--hydra-help", "--version", "--shell-completion", "-sc")
SWEEPS = ("-m", "--multirun", "hydra.mode=MULTIRUN")
# The first optimiser of a process imports PyTorch's compiler, to tell it to leave these methods alone: 1.3 s of CPU.
LEFT_ALONE = ("add_param_group", "state_dict", "load_state_dict", "zero_grad")
# `pytorch_optimizer` does without tensors that are spread over machines where it finds none: 0.5 s of CPU.
DISTRIBUTED = ("torch.distributed.tensor", "torch.distributed._tensor")


def launch(entry: Callable, config_name: str, check: Callable[[dict], object], work: Callable[..., object]) -> None:
    """Run the command line: ``work(check(data), folder)``, where ``data`` is the composed configuration ``config_name``.

    ``check`` refuses what is wrong, and builds what the work is done on, before any folder is made; a single run works on
    just that. Sweeps, and whatever else Hydra has options for, go through the Hydra ``entry``, which calls `job`. A user's
    mistake ends in one sentence on stderr and exit status 2, a signal in 143 or 130, failed jobs of a sweep in their names
    and status 2.
    """
    spare_imports()
    register_resolvers()
    logging.setLogRecordFactory(Record)
    logging.raiseExceptions = False  # a full disk is told once, not at every line of a log
    # A user's module is found where the command was given, as `python -m` would find it.
    sys.path.insert(0, os.getcwd())
    typed = list(sys.argv)
    sys.argv[1:] = with_own_defaults(config_name, sys.argv[1:])
    options = [a for a in sys.argv[1:] if a.startswith("-")]
    overrides = [a for a in sys.argv[1:] if not a.startswith("-")]
    try:
        if any(option.split("=")[0] in ASKS for option in options):
            entry()
        elif any(a in SWEEPS for a in sys.argv[1:]):
            sweep(entry, config_name, overrides, check)
        elif options:
            checked(overrides, config_name, check)
            entry()
        else:
            carry_out(checked(overrides, config_name, check), work)
    except ForeignProblem as error:
        fail(f"{str(error).rstrip('.')}; if it is yours: {shlex.join(['python', *typed, *error.arguments])}")
    except InputError as error:
        fail(str(error))
    except Preempted as stop:
        sys.exit(stop.status)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def sweep(entry: Callable, config_name: str, overrides: list[str], check: Callable[[dict], object]) -> None:
    """Run the jobs of a sweep, once each of them might run. Raises `InputError` that names those that failed."""
    require_places_to_write(overrides, "hydra.sweep.dir")
    check_sweep(config_name, overrides, check)
    root = next((o.value() for o in parsed(overrides) if o.key_or_group == "hydra.sweep.dir"), None)
    if root is not None:
        require_unlinked(Path(str(root)), "*")
    with failures() as failed:
        entry()
        names = failed()
    if names:
        raise InputError(f"{len(names)} job(s) of the sweep failed: {'; '.join(names)}.")


def spare_imports() -> None:
    """Spare this process PyTorch's compiler, until somebody compiles, and distributed tensors in the optimisers.

    For the process of a command only: in somebody else's program both may be wanted. Where PyTorch is made differently
    nothing happens, and the process starts as slowly as any other.
    """
    for name in LEFT_ALONE:
        method = getattr(getattr(Optimizer, name, None), "__wrapped__", None)
        if method is not None and not hasattr(method, "__dynamo_disable"):
            method.__dynamo_disable = method  # what `torch._disable_dynamo` looks for before it imports the compiler
    hidden = [name for name in DISTRIBUTED if name not in sys.modules]
    modules: dict[str, Any] = sys.modules
    modules.update(dict.fromkeys(hidden))  # an import of what is None there fails
    try:
        import pytorch_optimizer  # noqa: F401
    finally:
        for name in hidden:
            del sys.modules[name]
