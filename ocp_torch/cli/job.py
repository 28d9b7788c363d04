"""One job, alone or of a sweep: it leaves the process as it was, and its end is told in a sentence."""

import contextlib
import logging
import multiprocessing
import os
import re
import shlex
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from ocp_torch.cli.compose import resolved, run_data
from ocp_torch.cli.outcome import Record, fail, failed, typed
from ocp_torch.compute.processes import LostError
from ocp_torch.errors import InputError
from ocp_torch.files.reading import require_unlinked
from ocp_torch.maths.seeds import generators_kept
from ocp_torch.problems.blame import blamed
from ocp_torch.problems.commands import quoted
from ocp_torch.runs.configuration import adopt, locate
from ocp_torch.training.checkpoint import LAST
from ocp_torch.training.stopping import Preempted

log = logging.getLogger(__name__)


def job(check: Callable[[dict], object], work: Callable[..., object], config: DictConfig) -> None:
    """Carry out a job that Hydra has started: ``work(check(data), folder)``."""
    logging.setLogRecordFactory(Record)  # again here, as a launcher may have started this process
    hydra = HydraConfig.get()
    this = Job(hydra, Path(hydra.runtime.output_dir))
    with this.outcome():
        data = run_data(resolved(config), list(hydra.overrides.task), roots=(this.folder,))
        if hydra.output_subdir is not None:
            this.folder = settled(this.folder, data)
        work(check(data), this.folder)


def settled(folder: Path, data: dict) -> Path:
    """The folder that a job of a sweep works in: Hydra's fresh ``folder``, or that of the run it resumes."""
    if data.get("resume") is None:
        require_fresh(folder)
        return folder
    own = locate(Path(data["resume"]))[0]
    if own is None or own.resolve() == folder.resolve():
        return folder
    require_unlinked(own)
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.FileHandler):
            handler.close()  # the handler opens its file again at the next line
            handler.baseFilename = str((own / Path(handler.baseFilename).name).absolute())
    adopt(folder, own)
    return own


def require_fresh(folder: Path) -> None:
    """Raise `InputError` when ``folder`` holds a run that a new one would overwrite."""
    if (folder / "checkpoints" / LAST).exists():
        raise InputError(
            f"{folder} holds a run already; go on with it by resume={folder}, or give another hydra.run.dir."
        )


@dataclass
class Job:
    """A job: Hydra's own part of its configuration, and the folder it works in."""

    hydra: Any
    folder: Path

    @property
    def sweeping(self) -> bool:
        return self.hydra.mode == RunMode.MULTIRUN

    @contextlib.contextmanager
    def outcome(self):
        """Run the body; where it fails, end the process with a sentence and a status, or in a sweep only this job."""
        try:
            with isolated():
                yield
        except Preempted as stop:
            log.info("stopped by %s, saved; go on with: %s", stop, self.again())
            if not self.sweeping or multiprocessing.parent_process() is None:
                raise
            failed(self.hydra, f"stopped by {stop}")
        except (Exception, SystemExit) as error:
            error = blamed(error) or error
            if isinstance(error, SystemExit):
                raise
            if not self.sweeping:
                if isinstance(error, LostError):
                    fail(f"{str(error).rstrip('.')}; its state is saved, go on with: {self.again()}")
                if isinstance(error, InputError):
                    fail(str(error))
                raise
            if not isinstance(error, InputError):
                log.debug("%s", traceback.format_exc())
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            failed(self.hydra, " ".join(reason.split()))

    def again(self) -> str:
        """The command that goes on with this job after it was stopped."""
        if self.sweeping:
            return f"the sweep's own command with hydra.sweep.dir={self.hydra.sweep.dir} resume=auto"
        # A user's own problem, which only the command line may name.
        task = self.hydra.overrides.task
        mine = "problem." if "problem=callable" in task else "problem._target_="
        own = [o.lstrip("+") for o in task if o == "problem=callable" or o.lstrip("+").startswith(mine)]
        path = str(self.folder) if re.fullmatch(r"[\w./+-]+", str(self.folder)) else quoted(self.folder)
        return shlex.join([*typed(sys.argv[0]), f"resume={path}", *own])


@contextlib.contextmanager
def isolated():
    """Restore threads, precision, random numbers and paths after the body, so that jobs of a sweep are independent. Gradients
    are had in it, whatever the caller has switched off."""
    dtype, threads = torch.get_default_dtype(), torch.get_num_threads()
    path, folder = list(sys.path), os.getcwd()
    try:
        with generators_kept(), torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_default_dtype(dtype)
        torch.set_num_threads(threads)
        sys.path[:] = path
        os.chdir(folder)
