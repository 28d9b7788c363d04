"""The configurations in a run's folder, one for each start, as plain data; and the checkpoint that a path names."""

import contextlib
import os
import re
from pathlib import Path
from typing import Any

import yaml

from ocp_torch.errors import InputError
from ocp_torch.files.reading import FOLDER, kind, read_yaml
from ocp_torch.files.storage import write_atomically
from ocp_torch.problems.commands import current_name, current_section
from ocp_torch.training.checkpoint import LAST, load_checkpoint, newest

CONFIG, AUTO = "config.yaml", "auto"


def locate(path: Path) -> tuple[Path | None, Path | None]:
    """The run's folder and the checkpoint that ``path`` names. A folder stands for its newest good checkpoint (`None`); the
    folder of a checkpoint that is in no run's folder is `None`."""
    if "${" in str(path):
        raise InputError(f"resume is {str(path)!r}, which Hydra would take for an interpolation; rename the folder.")
    found = kind(path)
    if found == FOLDER:
        inside = [file for file in path.glob(f"*/checkpoints/{LAST}") if file.exists()]
        if inside and kind(path / "checkpoints") != FOLDER:  # which of several runs goes on is for the user to say
            last = max(inside, key=lambda file: file.stat().st_mtime).parent.parent
            raise InputError(
                f"resume is {str(path)!r}, which is no run but holds {len(inside)} of them; the newest is resume={last}."
            )
        return path, None
    if found is None:
        raise InputError(f"resume is {str(path)!r}, which does not exist; give a run's folder or a checkpoint.")
    return (path.absolute().parent.parent if path.absolute().parent.name == "checkpoints" else None), path


def load_state(path: Path) -> tuple[Any, Path, list[str]]:
    """The state that ``path`` names, in this version's names; its file; and a sentence on each newer, damaged file."""
    checkpoint = locate(path)[1]
    if checkpoint is not None:
        state, notes = load_checkpoint(checkpoint), list[str]()
    else:
        state, checkpoint, notes = newest(path / "checkpoints")
    config = state.get("config") if isinstance(state, dict) else None
    if isinstance(config, dict):
        name = current_name(state.get("problem"), config.get("problem"))
        state = {**state, "problem": name, "config": current(config)}
    return state, checkpoint, notes


def starts(folder: Path) -> list[Path]:
    """The folders of the configurations of all starts, the oldest first: `.hydra`, then `.hydra/resume_<n>`."""
    return [folder / ".hydra", *sorted((folder / ".hydra").glob("resume_*"), key=_number)]


def next_subfolder(folder: Path) -> str:
    """The subfolder for the configuration of the next start."""
    if not (folder / ".hydra" / CONFIG).exists():
        return ".hydra"
    return f".hydra/resume_{_number(starts(folder)[-1]) + 1}"


def _number(path: Path) -> int:
    found = re.fullmatch(r"resume_(\d{1,9})", path.name)
    return int(found.group(1)) if found else 0


def saved_configuration(path: Path) -> dict:
    """The plain configuration of the newest start of the run ``path`` that passed its checks, or its checkpoint's copy."""
    folder = locate(path)[0]
    for start in reversed(starts(folder)[1:] if folder else []):
        # Until a start has passed its checks, its file still names the run to resume, and may be half written.
        with contextlib.suppress(InputError, OSError):
            config = read_configuration(start / CONFIG)
            if config.get("resume", "") is None and (start / CONFIG).read_bytes().endswith(b"\n"):
                return config
    if folder is not None and kind(folder / ".hydra" / CONFIG) is not None:
        config = read_configuration(folder / ".hydra" / CONFIG)
        # A configuration that names a run belongs to a resume, in a folder that had no configuration before.
        if config.get("resume") in (None, AUTO):
            return {**config, "resume": None}
    config = load_state(path)[0].get("config")
    if not isinstance(config, dict):
        raise InputError(f"{path} holds no configuration.")
    return {**config, "resume": None}


def read_configuration(file: Path) -> dict:
    """A configuration file as plain nested data; no code in it runs. Raises `InputError` when it is damaged or crafted."""
    return current(read_yaml(file))


def current(config: dict) -> dict:
    """A ``config`` of any version as this one would have written it."""
    config = {name: value for name, value in config.items() if name != "hydra"}
    return {**config, "problem": current_section(config["problem"])} if "problem" in config else config


def keep_configuration(folder: Path, config: dict) -> None:
    """Write the configuration with which a run goes on, or begins again, in the folder of its newest start."""
    text = yaml.safe_dump({**config, "resume": None}, sort_keys=False, allow_unicode=True)
    write_atomically(starts(folder)[-1] / CONFIG, lambda temporary: temporary.write_text(text))


def adopt(stub: Path, folder: Path) -> None:
    """Move what Hydra wrote into the fresh ``stub`` to the run's own ``folder``, and remove the stub."""
    target = folder / next_subfolder(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    os.replace(stub / ".hydra", target)
    for log in stub.glob("*.log"):
        if log.stat().st_size == 0:
            log.unlink()
    if not any(stub.iterdir()):
        stub.rmdir()
