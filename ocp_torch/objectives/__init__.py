"""The methods: each maps Fields and Samples to one loss per player. `METHODS` maps names to their makers."""

from ocp_torch.objectives.dual import Dual
from ocp_torch.objectives.objective import Objective
from ocp_torch.objectives.primal import primal
from ocp_torch.objectives.saddle import saddle

METHODS = {"dual": Dual, "primal": primal, "pd": saddle}

__all__ = ["METHODS", "Dual", "Objective", "primal", "saddle"]
