"""Where a command writes: nothing is overwritten or written through a link, and a resume stays in its run's folder."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import tempfile
from pathlib import Path

from ocp_torch.errors import InputError, shown
from ocp_torch.files.reading import require_unlinked
from ocp_torch.runs.configuration import adopt, locate
from ocp_torch.training.checkpoint import LAST

# Where a run goes, as in configs/train.yaml, by the name of its problem and method.
FRESH = "${{checkout:outputs}}/{}/${{now:%Y-%m-%d_%H-%M-%S-%f}}"


def fresh_folder(data: dict) -> str:
    """Where a checkpoint that lies in no run's folder goes on, for Hydra to resolve: named after its own problem and
    method."""
    return FRESH.format(f"{str(data['problem']['_target_']).rpartition('.')[2].lower()}_{data['method']['name']}")


def require_fresh(folder: Path) -> None:
    """Raise `InputError` when ``folder`` holds a run that a new one would overwrite."""
    if (folder / "checkpoints" / LAST).exists():
        raise InputError(
            f"{folder} holds a run already; go on with it by resume={folder}, or give another hydra.run.dir."
        )


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


def settled(folder: Path, data: dict, make: bool) -> Path:
    """The folder that a job of a sweep works in: Hydra's fresh ``folder``, or that of the run it goes on with."""
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
