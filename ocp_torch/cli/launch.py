"""The glue between Hydra and the package: checks before anything is written, friendly errors, sweeps that go on."""

from __future__ import annotations

import contextlib
import errno
import logging
import multiprocessing
import os
import random
import re
import shlex
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from ocp_torch.cli.compose import (
    CHECKOUT,
    CONFIGS,
    check_sweep,
    composed,
    known_fields,
    parsed,
    plain,
    prepared,
    register_resolvers,
    with_own_defaults,
)
from ocp_torch.errors import InputError, shown, visible
from ocp_torch.files.reading import require_unlinked
from ocp_torch.problems.blame import blamed
from ocp_torch.problems.commands import ForeignProblem, quoted
from ocp_torch.runs.resume import adopt, locate
from ocp_torch.training.checkpoint import LAST
from ocp_torch.training.signals import Preempted

__all__ = ["CHECKOUT", "CONFIGS", "composed", "job", "known_fields", "launch", "register_resolvers"]

log = logging.getLogger(__name__)
FAILED_INPUT, INTERRUPTED = 2, 130
ASKS = ("--help", "-h", "--info", "-i", "--cfg", "-c", "--hydra-help", "--version", "--shell-completion", "-sc")
# Jobs of a sweep may run in processes of their own; this file, named in the environment, collects which failed.
FAILURES = "OCP_TORCH_FAILURES"
# Where a run goes, as in configs/train.yaml, by the name of its problem and method.
FRESH = "${{checkout:outputs}}/{}/${{now:%Y-%m-%d_%H-%M-%S-%f}}"
# A table with its warnings has fewer characters.
LONGEST_MESSAGE = 2**20


def launch(entry: Callable, config_name: str, check: Callable[[dict], object]) -> None:
    """Run the Hydra ``entry``; a single run is composed and handed to ``check`` first, before any folder is made.

    A user's mistake ends in one sentence on stderr and exit status 2, a signal in 143 or 130, failed jobs of a sweep in
    their names and status 2.
    """
    register_resolvers()
    logging.setLogRecordFactory(Record)
    logging.raiseExceptions = False  # a full disk is told once, not at every line of a log
    # A user's module is found where the command was given, as `python -m` would find it.
    sys.path.insert(0, os.getcwd())
    typed = list(sys.argv)
    sys.argv[1:] = with_own_defaults(config_name, sys.argv[1:])
    try:
        if not any(a.split("=")[0] in ASKS for a in sys.argv[1:]):
            sys.argv[1:] = checked(sys.argv[1:], config_name, check)
        with failures() as failed:
            entry()
            names = failed()
        if names:
            raise InputError(f"{len(names)} job(s) of the sweep failed: {'; '.join(names)}.")
    except ForeignProblem as error:
        fail(f"{str(error).rstrip('.')}; if it is yours: {shlex.join(['python', *typed, *error.arguments])}")
    except InputError as error:
        fail(str(error))
    except Preempted as stop:
        sys.exit(stop.status)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


class Record(logging.LogRecord):
    """A message of the log, fit for a terminal whatever names and notes of strangers are in it."""

    def getMessage(self) -> str:
        return visible(super().getMessage(), LONGEST_MESSAGE, keep="\n")


def checked(arguments: list[str], config_name: str, check: Callable[[dict], object]) -> list[str]:
    """The arguments to hand to Hydra: as they are, but for a resume, which goes on in the folder of its run."""
    overrides = [a for a in arguments if not a.startswith("-")]
    sweeping = any(a in ("-m", "--multirun") for a in arguments)
    for name in ("hydra.sweep.dir",) if sweeping else ("hydra.run.dir",):
        for value in (o.value() for o in parsed(overrides) if o.key_or_group == name and not o.is_sweep_override()):
            # What is only known later, such as the time, is below what can be looked at now.
            require_writable(name, Path(re.split(r"[^/]*\$\{", str(value))[0]))
    if sweeping:
        check_sweep(config_name, overrides, check)
        root = next((o.value() for o in parsed(overrides) if o.key_or_group == "hydra.sweep.dir"), None)
        if root is not None:
            require_unlinked(Path(str(root)), "*")
        return arguments
    given = {o.key_or_group: o.value() for o in parsed(overrides) if not o.is_sweep_override() and not o.is_delete()}
    own = Path(str(given["hydra.run.dir"])) if "hydra.run.dir" in given else None
    try:
        data = composed(config_name, overrides, roots=(own,) if own else ())
        folder = own if data.get("resume") is None else locate(Path(data["resume"]))[0]
        if folder is not None:
            require_unlinked(folder)
        check(data)
    except OSError as error:  # a name that no file can have, a device that gives nothing
        told = blamed(error)
        named = f"{shown(str(error.filename))} cannot be used" if error.filename else "a file cannot be used"
        raise told or InputError(f"{named}: {error.strerror or error}.") from None
    except (Exception, SystemExit) as error:
        told = blamed(error)
        if told is None and isinstance(error, SystemExit):  # somebody's module would end the run without a word
            told = InputError(f"the code that the command line names asks Python to exit (status {error.code}).")
        raise told or error from None
    if data.get("resume") is None:
        if own is not None and "resume" in data:
            require_fresh(own)
        return arguments
    if folder is None:
        # A checkpoint alone goes on in a folder named after its own problem and method.
        name = f"{str(data['problem']['_target_']).rpartition('.')[2].lower()}_{data['method']['name']}"
        return arguments if own is not None else [*arguments, f"hydra.run.dir='{FRESH.format(name)}'"]
    kept = [a for a in arguments if not a.lstrip("+").startswith(("resume=", "hydra.run.dir="))]
    return [*kept, f"resume={quoted(data['resume'])}", f"hydra.run.dir={quoted(folder)}"]


def require_fresh(folder: Path) -> None:
    """Raise `InputError` when ``folder`` holds a run that a new one would overwrite."""
    if (folder / "checkpoints" / LAST).exists():
        raise InputError(
            f"{folder} holds a run already; go on with it by resume={folder}, or give another hydra.run.dir."
        )


def fail(sentence: str) -> None:
    """Print one sentence, on one line and without endless numbers and words, and leave with the status of a wrong input."""
    line = re.sub(r"\d{40,}", lambda digits: f"{digits[0][:6]}...({len(digits[0])} digits)", " ".join(sentence.split()))
    line = re.sub(r"\S{300,}", lambda word: f"{word[0][:80]}...", line)  # a path of thousands of letters
    print(f"error: {visible(line)}", file=sys.stderr)
    sys.exit(FAILED_INPUT)


def require_writable(name: str, folder: Path) -> None:
    """Raise `InputError` unless files can be written to ``folder``, or to it once it is made; leaves nothing behind."""
    made: list[Path] = []
    try:
        if len(os.fsencode(folder.absolute())) >= os.pathconf("/", "PC_PATH_MAX"):
            raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
        for part in (*reversed(folder.absolute().parents), folder.absolute()):
            if not part.exists():
                part.mkdir()
                made.append(part)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{name} is {shown(str(folder))}, where nothing can be written: {reason}.") from None
    finally:
        for part in reversed(made):
            with contextlib.suppress(OSError):
                part.rmdir()


def job(task: Callable[[dict, Path], object], config: DictConfig) -> None:
    """Run ``task(config, folder)`` as a Hydra job. In a sweep whatever goes wrong ends its own job only."""
    logging.setLogRecordFactory(Record)  # the process may be one that a launcher started
    hydra = HydraConfig.get()
    sweeping = hydra.mode == RunMode.MULTIRUN
    folder = Path(hydra.runtime.output_dir)
    try:
        with isolated():
            data = prepared(plain(config), list(hydra.overrides.task), roots=(folder,))
            folder = settled(folder, data, make=hydra.output_subdir is not None)
            task(data, folder)
    except Preempted as stop:
        log.info("stopped by %s, saved; go on with: %s", stop, again(hydra, folder, sweeping))
        if not sweeping or multiprocessing.parent_process() is None:
            raise
        failed(hydra, f"stopped by {stop}")
    except (Exception, SystemExit) as error:
        error = blamed(error) or error
        if isinstance(error, SystemExit):
            raise
        if not sweeping and isinstance(error, InputError):
            fail(str(error))
        if not sweeping:
            raise
        if not isinstance(error, InputError):
            log.debug("%s", traceback.format_exc())
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        failed(hydra, " ".join(reason.split()))


def settled(folder: Path, data: dict, make: bool) -> Path:
    """The folder the job works in: Hydra's fresh ``folder``, or that of the run it goes on with."""
    if not make:
        return folder
    if data.get("resume") is None:
        require_fresh(folder)
        return folder
    own = locate(Path(data["resume"]))[0]
    if own is None or own.resolve() == folder.resolve():
        return folder
    require_unlinked(own)
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler):
            handler.close()  # it opens its file again at the next line
            handler.baseFilename = str((own / Path(handler.baseFilename).name).absolute())
    adopt(folder, own)
    return own


def again(hydra: DictConfig, folder: Path, sweeping: bool) -> str:
    """The command that goes on with what was stopped."""
    # What only the command line may name.
    mine = "problem." if "problem=callable" in hydra.overrides.task else "problem._target_="
    own = [o.lstrip("+") for o in hydra.overrides.task if o == "problem=callable" or o.lstrip("+").startswith(mine)]
    if not sweeping:
        path = str(folder) if re.fullmatch(r"[\w./+-]+", str(folder)) else quoted(folder)
        return shlex.join(["python", sys.argv[0], f"resume={path}", *own])
    return f"the sweep's own command with hydra.sweep.dir={hydra.sweep.dir} resume=auto"


@contextlib.contextmanager
def isolated():
    """Leave the process as it was: no job of a sweep finds another one's threads, precision or random numbers."""
    dtype, threads, deterministic = torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled()
    states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    path, folder = list(sys.path), os.getcwd()
    try:
        yield
    finally:
        torch.set_default_dtype(dtype)
        torch.set_num_threads(threads)
        torch.set_grad_enabled(deterministic)
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])
        sys.path[:] = path
        os.chdir(folder)


@contextlib.contextmanager
def failures():
    """Collect the failed jobs of all processes; yields a function that names them."""
    with tempfile.TemporaryDirectory(prefix="ocp_torch_") as folder:
        file = Path(folder) / "failed"
        os.environ[FAILURES] = str(file)
        try:
            number = lambda line: int(line.split(" ")[0])
            yield lambda: sorted(file.read_text().splitlines(), key=number) if file.exists() else []
        finally:
            os.environ.pop(FAILURES, None)


def failed(hydra: DictConfig, reason: str) -> None:
    """Say that a job of a sweep failed, and have it named at the end."""
    name = hydra.job.override_dirname
    sentence = visible(f"error: job {hydra.job.num} ({name}): {reason}")
    print(sentence, file=sys.stderr)
    log.debug("%s", sentence)  # to its own train.log as well
    if FAILURES in os.environ:
        with open(os.environ[FAILURES], "a") as file:
            file.write(f"{hydra.job.num} ({name})\n")
