"""A problem is checked once, before anything is trained: `check_once`. Each file holds one kind of check."""

from ocp_torch.problems.checks.check import check_once

__all__ = ["check_once"]
