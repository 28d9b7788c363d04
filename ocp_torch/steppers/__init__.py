"""Steppers say in which order players move, optimisers do the arithmetic. `STEPPERS` maps names to classes."""

from ocp_torch.steppers.extragradient import Extragradient
from ocp_torch.steppers.fitting import Average, advance, averaged, optimizer_maker, schedule_maker, short_fit
from ocp_torch.steppers.nonfinite import NonFiniteError
from ocp_torch.steppers.simultaneous import Simultaneous
from ocp_torch.steppers.stepper import Stepper, StepReport

STEPPERS = {"simultaneous": Simultaneous, "extragradient": Extragradient}

__all__ = [
    "STEPPERS",
    "Average",
    "Extragradient",
    "NonFiniteError",
    "Simultaneous",
    "StepReport",
    "Stepper",
    "advance",
    "averaged",
    "optimizer_maker",
    "schedule_maker",
    "short_fit",
]
