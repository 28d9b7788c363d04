"""What represents `V`, `w` and `log mu`: anything periodic and differentiable. `MODELS` maps names to network classes."""

from ocp_torch.fields.fields import CONTROL_DENSITY, LOG_OCCUPATION, VALUE, Fields
from ocp_torch.fields.mlp import PeriodicMLP
from ocp_torch.fields.sobolev import SobolevField

MODELS = {"mlp": PeriodicMLP, "sobolev": SobolevField}

__all__ = ["CONTROL_DENSITY", "LOG_OCCUPATION", "MODELS", "VALUE", "Fields", "PeriodicMLP", "SobolevField"]
