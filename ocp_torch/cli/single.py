"""A single run: checked before anything is written; the objects that the check built are then run, in this process."""

import contextlib
import errno
import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.utils import run_job
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, read_write

from ocp_torch.cli.compose import configuration, parsed, run_data
from ocp_torch.cli.explain import CONFIGS
from ocp_torch.cli.job import Job, require_fresh
from ocp_torch.compute.processes import joined
from ocp_torch.errors import InputError, shown
from ocp_torch.files.reading import require_unlinked
from ocp_torch.problems.blame import blamed
from ocp_torch.runs.configuration import locate

# Folder for a run that resumes a checkpoint in no run's folder, by its problem and method, as in configs/train.yaml.
FRESH = "${{checkout:outputs}}/{}_{}/${{now:%Y-%m-%d_%H-%M-%S-%f}}"


@dataclass(frozen=True)
class Checked:
    """A command that passed its check: its configuration, with Hydra's part, and the objects that the check ``made``."""

    config_name: str
    config: DictConfig
    made: object


def checked(arguments: list[str], config_name: str, check: Callable[[dict], object]) -> Checked:
    """The checked command of ``arguments``, without Hydra's own options; a resume goes on in the folder of its run.

    Raises `InputError` for every mistake that can be found before a folder is made.
    """
    require_places_to_write(arguments, "hydra.run.dir")
    given = {o.key_or_group: o.value() for o in parsed(arguments) if not o.is_sweep_override() and not o.is_delete()}
    own = Path(str(given["hydra.run.dir"])) if "hydra.run.dir" in given else None
    config, data = configuration(config_name, arguments)
    with told():
        data = run_data(data, arguments, roots=(own,) if own else ())
        going_on = data.get("resume") is not None
        folder = locate(Path(data["resume"]))[0] if going_on else own
        if folder is not None:
            require_unlinked(folder)
        if folder is not None and going_on:
            require_writable(folder, "resume")
        made = check(data)
    if own is not None and "resume" in data and not going_on:
        require_fresh(own)
    if going_on:
        fresh = FRESH.format(str(data["problem"]["_target_"]).rpartition(".")[2].lower(), data["method"]["name"])
        place = next((str(given) for given in (folder, own) if given is not None), fresh)
        with read_write(config):
            OmegaConf.update(config, "hydra.run.dir", place)
    return Checked(config_name, config, made)


@contextlib.contextmanager
def told():
    """Turn errors in the body that are a user's into an `InputError` of one sentence."""
    try:
        yield
    except OSError as error:  # such as a name that no file can have, or a device that cannot be read
        named = f"{shown(str(error.filename))} cannot be used" if error.filename else "a file cannot be used"
        raise blamed(error) or InputError(f"{named}: {error.strerror or error}.") from None
    except (Exception, SystemExit) as error:
        sentence: InputError | None = blamed(error)
        if sentence is None and isinstance(error, SystemExit):  # a user's module would end the run without a message
            sentence = InputError(f"the code that the command line names asks Python to exit (status {error.code}).")
        raise sentence or error from None


def require_places_to_write(arguments: list[str], name: str) -> None:
    """`require_writable` for the folders that the override ``name`` gives."""
    for value in (o.value() for o in parsed(arguments) if o.key_or_group == name and not o.is_sweep_override()):
        # The part before an interpolation such as the time, which is only known later.
        require_writable(Path(re.split(r"[^/]*\$\{", str(value))[0]), name)


def require_writable(folder: Path, name: str) -> None:
    """Raise `InputError`, about the field ``name``, unless files can be written to ``folder``; leaves nothing behind."""
    if not joined().first:  # only the first process writes
        return
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


def carry_out(command: Checked, work: Callable[..., object]) -> None:
    """`Hydra.run` for a checked command: make the folder, begin its log, and do the ``work`` on what the check made."""
    config = command.config

    def task(_: DictConfig) -> None:
        hydra = HydraConfig.get()
        this = Job(hydra, Path(hydra.runtime.output_dir))
        with this.outcome():
            work(command.made, this.folder)

    with initialize_config_dir(str(CONFIGS), job_name=command.config_name, version_base="1.3"):
        context = HydraContext(GlobalHydra.instance().config_loader(), Callbacks(config))
        with read_write(config):
            config.hydra.mode = RunMode.RUN
        done = run_job(task, config, job_dir_key="hydra.run.dir", job_subdir_key=None, hydra_context=context)
    _ = done.return_value  # raises the error of the job, if there was one
