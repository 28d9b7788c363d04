"""The practitioner's numbers of a finished run, in a file of their own beside the certificate."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from ocp_torch.control.policies import Policy
from ocp_torch.files.storage import write_atomically
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.runs.metrics.trial import metrics, metrics_table

log = logging.getLogger(__name__)
METRICS = "metrics.json"


def write_metrics(problem: Problem, policy: Policy, seed: int, folder: Path | None) -> dict | None:
    """Print the numbers of ``policy`` and write them as `metrics.json` in ``folder``, where the problem has any."""
    found = metrics(problem, policy, derive_seed(seed, Branch.METRICS))
    if found is None:
        return None
    log.info("\n%s", metrics_table(found))
    if folder is not None:
        text = json.dumps(found, indent=2) + "\n"
        write_atomically(folder / METRICS, lambda path: Path(path).write_text(text))
    return found
