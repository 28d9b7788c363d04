"""Certify a finished run again."""

from ocp_torch.cli.command import Command
from ocp_torch.runs.evaluate import recertification

main = Command("evaluate", recertification, lambda recertify, folder: recertify())
