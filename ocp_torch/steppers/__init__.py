"""Steppers order the calls, optimisers do the arithmetic. `STEPPERS` maps names to classes."""

from ocp_torch.steppers.averaging import averaged
from ocp_torch.steppers.extragradient import Extragradient
from ocp_torch.steppers.nonfinite import NonFiniteError
from ocp_torch.steppers.optimizers import optimizer_maker, schedule_maker
from ocp_torch.steppers.simultaneous import Simultaneous
from ocp_torch.steppers.stepper import Stepper, StepReport

STEPPERS = {"simultaneous": Simultaneous, "extragradient": Extragradient}

__all__ = [
    "STEPPERS",
    "Extragradient",
    "NonFiniteError",
    "Simultaneous",
    "StepReport",
    "Stepper",
    "averaged",
    "optimizer_maker",
    "schedule_maker",
]
