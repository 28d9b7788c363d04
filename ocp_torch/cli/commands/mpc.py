"""Model-predictive control with `V` at the end of a short horizon."""

from ocp_torch.cli.command import Command
from ocp_torch.studies.horizons import horizons

main = Command("mpc", horizons, lambda work, folder: work())
