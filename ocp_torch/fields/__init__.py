"""What represents `V`, `w` and `log mu`: anything periodic and differentiable. `MODELS` maps names to network classes.

A class is made from ``dim``, ``outputs`` (`None` for a scalar field), ``shift`` and ``scale``, the units of what it
represents, ``centred``, whether it may resolve a state of rest, and from arguments of its own that `model` configures;
``defaults(dim, worst_state, noisy)`` gives those that are null.
"""

from typing import Any

from ocp_torch.fields.fields import CONTROL_DENSITY, LOG_OCCUPATION, SUBSOLUTION, TRAJECTORY_VALUE, VALUE, Fields, made
from ocp_torch.fields.mlp import PeriodicMLP
from ocp_torch.fields.sobolev import SobolevField
from ocp_torch.fields.subsolution import Subsolution

MODELS: dict[str, Any] = {"mlp": PeriodicMLP, "sobolev": SobolevField}

__all__ = [
    "CONTROL_DENSITY",
    "LOG_OCCUPATION",
    "MODELS",
    "SUBSOLUTION",
    "TRAJECTORY_VALUE",
    "VALUE",
    "Fields",
    "PeriodicMLP",
    "SobolevField",
    "Subsolution",
    "made",
]
