"""Compare methods and models on one problem."""

from ocp_torch.cli.command import Command
from ocp_torch.studies.benchmark.contest import Contest

main = Command("benchmark", Contest, Contest.run)
