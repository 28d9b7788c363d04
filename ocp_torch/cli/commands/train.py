"""Train a controller and its certificate."""

from ocp_torch.cli.command import Command
from ocp_torch.runs.run import train, training_run

main = Command("train", training_run, train)
