"""The command line in a process of its own that starts at once: a fork of the tests', which has imported everything."""

from __future__ import annotations

import contextlib
import json
import os
import runpy
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytorch_optimizer  # noqa: F401 (so that no child has to import it)
import torch

import ocp_torch.runs.run  # noqa: F401 (as above)
from ocp_torch.cli.explain import CHECKOUT

torch.optim.SGD([torch.zeros(1, requires_grad=True)])  # the first optimiser of a process imports much more

# A run of well under a second whose steps, looks, checkpoints and certificate all take a while to be killed in.
TINY = (
    "problem=circle",
    "method=dual",
    "model.width=8",
    "model.depth=2",
    "model.modes=2",
    "trainer.steps=60",
    "trainer.batch=16",
    "trainer.log_every=5",
    "trainer.evaluate_every=0",
    "trainer.checkpoint_every=10",
    "trainer.device=cpu",
    "trainer.figures=false",
    "certificate.points=64",
    "certificate.replicates=2",
    "certificate.trajectories=0",
    "certificate.ascents=1",
    "certificate.occupation_states=0",
    "certificate.stage.steps=0",
)


@dataclass
class Ended:
    """How a command ended: its exit status as a shell tells it, and what it printed."""

    status: int
    stdout: str
    stderr: str

    @property
    def sentence(self) -> str:
        """The one sentence it was refused with."""
        assert self.status not in (0, 1), self
        assert "Traceback" not in self.stdout + self.stderr, self
        (line,) = [line for line in self.stderr.splitlines() if line.startswith("error: ")]
        return line


class Command:
    """`python scripts/<name>.py <arguments>` under way in ``cwd``; its process can be sent signals."""

    def __init__(self, name: str, *arguments: str, cwd: Path, before=None) -> None:
        self.out, self.err = cwd / f".{name}.out", cwd / f".{name}.err"
        self.process = os.fork()
        if self.process == 0:
            status = 70
            try:
                status = _run(name, list(arguments), cwd, self.out, self.err, before)
            finally:
                os._exit(status)

    @property
    def running(self) -> bool:
        return os.waitid(os.P_PID, self.process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None

    def send(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process, number)

    def wait(self, seconds: float = 900.0) -> Ended:
        deadline = time.monotonic() + seconds
        while True:
            done, code = os.waitpid(self.process, os.WNOHANG)
            if done:
                break
            if time.monotonic() > deadline:
                os.kill(self.process, signal.SIGKILL)
            time.sleep(0.002)
        status = os.waitstatus_to_exitcode(code)
        ended = Ended(128 - status if status < 0 else status, self.out.read_text(), self.err.read_text())
        self.out.unlink()
        self.err.unlink()
        return ended


def command(name: str, *arguments: str, cwd: Path, before=None) -> Ended:
    return Command(name, *arguments, cwd=cwd, before=before).wait()


def train(*arguments: str, cwd: Path, before=None) -> Ended:
    return command("train", *arguments, cwd=cwd, before=before)


def completed(*arguments: str, cwd: Path, before=None) -> Ended:
    """The same, of a run that must end well."""
    ended = train(*arguments, cwd=cwd, before=before)
    assert ended.status == 0, ended
    return ended


def finished_run(folder: Path, *arguments: str) -> Path:
    """A finished run in ``folder``."""
    completed(*arguments, f"hydra.run.dir={folder}", cwd=folder.parent)
    return folder


def script(name: str, *arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    """The same, from a process that has imported everything."""
    ended = command(name, *arguments, cwd=cwd)
    return subprocess.CompletedProcess([name, *arguments], ended.status, ended.stdout, ended.stderr)


def certificate_in(folder: Path) -> dict:
    return json.loads((folder / "certificate.json").read_text())


def assert_succeeded(result: subprocess.CompletedProcess) -> None:
    assert result.returncode == 0, result.stderr
    assert "error" not in result.stderr.lower()


def slowly():
    """In the child: a step takes long enough to be met by a signal, and says where it is."""
    from ocp_torch.training.trainer import Trainer

    step = Trainer._advance

    def advance(trainer, monitor, checkpoint):
        step(trainer, monitor, checkpoint)
        print("stepped", trainer.step, flush=True)
        time.sleep(0.01)

    Trainer._advance = advance


def _run(name: str, arguments: list[str], cwd: Path, out: Path, err: Path, before) -> int:
    """In the child: as a fresh interpreter would run the script."""
    for file, number in ((out, 1), (err, 2)):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    # pytest's capture replaced these objects; the child writes to its own files.
    sys.stdout, sys.stderr = (os.fdopen(n, "w", buffering=1) for n in (1, 2))
    os.chdir(cwd)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    sys.argv = [f"{name}.py", *arguments]
    try:
        if before is not None:
            before()
        runpy.run_path(str(CHECKOUT / "scripts" / f"{name}.py"), run_name="__main__")
        return 0
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
        return 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
