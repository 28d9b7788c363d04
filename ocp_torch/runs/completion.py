"""Whether all that a run leaves at its end is there: a start may have been killed between two of its files."""

from __future__ import annotations

from pathlib import Path

from ocp_torch.certificate import CertificateSettings
from ocp_torch.files.storage import write_atomically
from ocp_torch.runs.metrics import METRICS, has_metrics
from ocp_torch.runs.pictures import scene
from ocp_torch.training.trainer import Trainer

# Lies beside the checkpoints from before the first file of the end is written until after the last.
MARK = "checkpoints/unfinished"


def begin(folder: Path) -> None:
    """The files of the end are about to be written."""
    write_atomically(folder / MARK, lambda path: path.write_text("a resume makes what is missing\n"))


def complete(folder: Path) -> None:
    """All of them are."""
    (folder / MARK).unlink(missing_ok=True)


def missing(folder: Path, trainer: Trainer, settings: CertificateSettings) -> str | None:
    """What the end of the run in ``folder`` lacks, in words, or `None`."""
    files = ["certificate.json", "controller.safetensors"]
    if trainer.settings.figures:
        drawn = ["certificate", *(["motion"] if scene(trainer.problem) is not None else [])]
        files += [f"figures/{name}.png" for name in drawn]
    if settings.trajectories and has_metrics(trainer.problem):
        files.append(METRICS)
    absent = [file for file in files if not (folder / file).is_file()]
    if absent:
        return ", ".join(absent)
    return "some of its last files" if (folder / MARK).exists() else None
