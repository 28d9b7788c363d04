"""The methods: each maps Fields and Samples to one loss per player. `METHODS` maps names to their makers."""

from ocp_torch.objectives.dual import Dual
from ocp_torch.objectives.objective import Objective
from ocp_torch.objectives.primal import primal
from ocp_torch.objectives.saddle import Saddle

METHODS = {"dual": Dual, "primal": primal, "pd": Saddle}

__all__ = ["METHODS", "Dual", "Objective", "Saddle", "primal"]
