"""The practitioner's numbers and picture of a finished run, in files of their own beside the certificate."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from matplotlib.figure import Figure

from ocp_torch.files.storage import write_atomically
from ocp_torch.maths.sampling import derive_seed
from ocp_torch.problems import Problem
from ocp_torch.runs.pictures import motion
from ocp_torch.runs.practice import metrics, metrics_table
from ocp_torch.runs.practice.paths import Law

log = logging.getLogger(__name__)
METRICS = "metrics.json"
# Branch of the seeds of practical starts.
STREAM = 8


def write_metrics(problem: Problem, policy: Law, seed: int, folder: Path | None) -> dict | None:
    """Print the numbers of ``policy`` and write them as `metrics.json` in ``folder``, where the problem has any."""
    found = metrics(problem, policy, derive_seed(seed, STREAM))
    if found is None:
        return None
    log.info("\n%s", metrics_table(found))
    if folder is not None:
        text = json.dumps(found, indent=2) + "\n"
        write_atomically(folder / METRICS, lambda path: Path(path).write_text(text))
    return found


def practical_figures(problem: Problem, policy: Law, seed: int) -> dict[str, Figure]:
    """`motion`, for problems that have a scene."""
    figure = motion(problem, policy, seed)
    return {} if figure is None else {"motion": figure}
