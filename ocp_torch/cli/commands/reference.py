"""`OPT` from grids, in one to three dimensions."""

from ocp_torch.cli.command import Command
from ocp_torch.studies.reference.session import ReferenceJob

main = Command("reference", ReferenceJob, lambda made, folder: made.run())
