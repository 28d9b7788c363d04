"""The end of a command: one sentence and an exit status, or the names of the failed jobs of a sweep."""

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
# Exit statuses.
FAILED_INPUT = 2
INTERRUPTED = 130
BROKEN_PIPE = 141
# Environment variable with the file in which jobs of a sweep, maybe in processes of their own, note that they failed.
FAILURES = "OCP_TORCH_FAILURES"
# Characters of a message of the log, at most; a table with its warnings has fewer.
LONGEST_MESSAGE = 2**20


def typed(command: str) -> list[str]:
    """The words typed to start ``command``, the first of `sys.argv`: a script, or an installed command."""
    return ["python", command] if command.endswith(".py") else [Path(command).name]


class Record(logging.LogRecord):
    """A message of the log without control characters, which names from untrusted files may contain."""

    def getMessage(self) -> str:
        return visible(super().getMessage(), LONGEST_MESSAGE, keep="\n")


def show(text: str) -> None:
    """Print ``text``; leave quietly when the reader, such as `head`, closes the pipe."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(BROKEN_PIPE)


def fail(sentence: str) -> None:
    """Print an error on one line, with very long numbers and words shortened, and exit with the status of a wrong input."""
    line = re.sub(r"\d{40,}", lambda digits: f"{digits[0][:6]}...({len(digits[0])} digits)", " ".join(sentence.split()))
    line = re.sub(r"\S{300,}", lambda word: f"{word[0][:80]}...", line)  # such as a path of thousands of letters
    print(f"error: {visible(line)}", file=sys.stderr)
    sys.exit(FAILED_INPUT)


@contextlib.contextmanager
def failures(elsewhere: bool = False):
    """Collect the failed jobs of all processes; yields a function that names them. With ``elsewhere`` the jobs run on other
    machines, and note failures in the current folder, which they share. Raises `InputError` where that is not writable."""
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
    """Print that a job of a sweep failed, and note it for `failures`."""
    name = hydra.job.override_dirname
    sentence = visible(f"error: job {hydra.job.num} ({name}): {reason}")
    print(sentence, file=sys.stderr)
    log.debug("%s", sentence)  # to its own train.log as well
    if FAILURES in os.environ:
        with open(os.environ[FAILURES], "a") as file:
            file.write(f"{hydra.job.num} ({name})\n")
