"""What a practitioner asks of a controller: does it reach, avoid, synchronise; against nothing and against the classics.

`measures` says what is measured on each system, `classical` holds its classical controller, `trial` runs them all from the
same starts, and `writing` leaves `metrics.json` in a run's folder.
"""

from ocp_torch.runs.metrics.classical import classical_policy
from ocp_torch.runs.metrics.measures import has_metrics
from ocp_torch.runs.metrics.trajectories import Path, simulate
from ocp_torch.runs.metrics.trial import metrics, metrics_table, random_starts
from ocp_torch.runs.metrics.writing import METRICS, write_metrics

__all__ = [
    "METRICS",
    "Path",
    "classical_policy",
    "has_metrics",
    "metrics",
    "metrics_table",
    "random_starts",
    "simulate",
    "write_metrics",
]
