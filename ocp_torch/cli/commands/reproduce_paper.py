"""Every figure and number of the sections on numerics of the paper."""

from ocp_torch.cli.command import Command
from ocp_torch.studies.paper.reproduce import check, reproduce

main = Command("reproduce_paper", check, reproduce)
