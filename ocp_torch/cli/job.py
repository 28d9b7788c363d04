"""One job, alone or of a sweep: it leaves nothing in the process, and its end is told in a sentence."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import random
import re
import shlex
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig

from ocp_torch.cli.compose import resolved, run_data
from ocp_torch.cli.folders import settled
from ocp_torch.cli.outcome import Record, fail, failed
from ocp_torch.errors import InputError
from ocp_torch.problems.blame import blamed
from ocp_torch.problems.commands import quoted
from ocp_torch.training.stopping import Preempted

log = logging.getLogger(__name__)


def job(check: Callable[[dict], object], work: Callable[..., object], config: DictConfig) -> None:
    """A job that Hydra has started: ``work(check(data), folder)``."""
    logging.setLogRecordFactory(Record)  # the process may be one that a launcher started
    hydra = HydraConfig.get()
    this = Job(hydra, Path(hydra.runtime.output_dir))
    with this.outcome():
        data = run_data(resolved(config), list(hydra.overrides.task), roots=(this.folder,))
        this.folder = settled(this.folder, data, make=hydra.output_subdir is not None)
        work(check(data), this.folder)


@dataclass
class Job:
    """What Hydra says of a job, and the folder it works in."""

    hydra: Any  # Hydra's own part of the configuration
    folder: Path

    @property
    def sweeping(self) -> bool:
        return self.hydra.mode == RunMode.MULTIRUN

    @contextlib.contextmanager
    def outcome(self):
        """What is done within ends the process with a sentence and a status where it fails; in a sweep, its own job only."""
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
            if not self.sweeping and isinstance(error, InputError):
                fail(str(error))
            if not self.sweeping:
                raise
            if not isinstance(error, InputError):
                log.debug("%s", traceback.format_exc())
            reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            failed(self.hydra, " ".join(reason.split()))

    def again(self) -> str:
        """The command that goes on with what was stopped."""
        if self.sweeping:
            return f"the sweep's own command with hydra.sweep.dir={self.hydra.sweep.dir} resume=auto"
        # What only the command line may name.
        task = self.hydra.overrides.task
        mine = "problem." if "problem=callable" in task else "problem._target_="
        own = [o.lstrip("+") for o in task if o == "problem=callable" or o.lstrip("+").startswith(mine)]
        path = str(self.folder) if re.fullmatch(r"[\w./+-]+", str(self.folder)) else quoted(self.folder)
        return shlex.join(["python", sys.argv[0], f"resume={path}", *own])


@contextlib.contextmanager
def isolated():
    """Leave the process as it was: no job of a sweep finds another one's threads, precision or random numbers."""
    dtype, threads, gradients = torch.get_default_dtype(), torch.get_num_threads(), torch.is_grad_enabled()
    states = torch.get_rng_state(), np.random.get_state(), random.getstate()  # noqa: NPY002
    path, folder = list(sys.path), os.getcwd()
    try:
        yield
    finally:
        torch.set_default_dtype(dtype)
        torch.set_num_threads(threads)
        torch.set_grad_enabled(gradients)
        torch.set_rng_state(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        random.setstate(states[2])
        sys.path[:] = path
        os.chdir(folder)
