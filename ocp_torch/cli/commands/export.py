"""A saved controller for where there is no PyTorch."""

from ocp_torch.cli.command import Command
from ocp_torch.runs.export import exporting

main = Command("export", exporting, lambda work, folder: work())
