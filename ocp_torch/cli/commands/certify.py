"""Certify any controller."""

from ocp_torch.cli.command import Command
from ocp_torch.runs.external import arguments, certify_in

main = Command("certify", arguments, certify_in)
