"""How a command ends: in one sentence and a status, or in the names of the jobs of a sweep that failed."""

import contextlib
import logging
import os
import re
import sys
import tempfile
from pathlib import Path

from omegaconf import DictConfig

from ocp_torch.errors import InputError, visible

log = logging.getLogger(__name__)
FAILED_INPUT, INTERRUPTED, BROKEN_PIPE = 2, 130, 141
# Jobs of a sweep may run in processes of their own; this file, named in the environment, collects which failed.
FAILURES = "OCP_TORCH_FAILURES"
# A table with its warnings has fewer characters.
LONGEST_MESSAGE = 2**20


def typed(command: str) -> list[str]:
    """What was typed to start ``command``, the first of `sys.argv`: a script, or a command that was installed."""
    return ["python", command] if command.endswith(".py") else [Path(command).name]


class Record(logging.LogRecord):
    """A message of the log, fit for a terminal whatever names and notes of strangers are in it."""

    def getMessage(self) -> str:
        return visible(super().getMessage(), LONGEST_MESSAGE, keep="\n")


def fail(sentence: str) -> None:
    """Print one sentence, on one line and without endless numbers and words, and leave with the status of a wrong input."""
    line = re.sub(r"\d{40,}", lambda digits: f"{digits[0][:6]}...({len(digits[0])} digits)", " ".join(sentence.split()))
    line = re.sub(r"\S{300,}", lambda word: f"{word[0][:80]}...", line)  # a path of thousands of letters
    print(f"error: {visible(line)}", file=sys.stderr)
    sys.exit(FAILED_INPUT)


@contextlib.contextmanager
def failures(elsewhere: bool = False):
    """Collect the failed jobs of all processes, of those ``elsewhere`` in the folder one starts from, which machines of a
    cluster share; yields a function that names them. Raises `InputError` where nothing can be written there."""
    shared = os.getcwd() if elsewhere else None
    if shared is not None and not os.access(shared, os.W_OK):
        raise InputError(f"jobs on other machines say in {shared} that they failed, but it cannot be written to.")
    with tempfile.TemporaryDirectory(prefix=".ocp_torch_", dir=shared) as folder:
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
