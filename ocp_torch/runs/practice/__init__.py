"""What a practitioner asks of a controller: does it reach, avoid, synchronise; against nothing and against the classics."""

from ocp_torch.runs.practice.classical import classical_policy
from ocp_torch.runs.practice.metrics import has_metrics, metrics, metrics_table
from ocp_torch.runs.practice.paths import Path, simulate

__all__ = ["Path", "classical_policy", "has_metrics", "metrics", "metrics_table", "simulate"]
