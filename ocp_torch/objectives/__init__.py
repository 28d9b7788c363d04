"""The methods: each maps Fields, Samples and a Phase to one loss per player. `METHODS` maps names to their makers."""

from collections.abc import Callable

from ocp_torch.objectives.dual import Dual
from ocp_torch.objectives.objective import Objective, Phase
from ocp_torch.objectives.primal import primal
from ocp_torch.objectives.saddle import saddle

METHODS: dict[str, Callable[..., Objective]] = {"dual": Dual, "primal": primal, "pd": saddle}

__all__ = ["METHODS", "Dual", "Objective", "Phase", "primal", "saddle"]
