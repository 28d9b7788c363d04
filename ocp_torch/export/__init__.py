"""Functions of the state exported to ONNX, C99 and CasADi, for use without PyTorch."""

from ocp_torch.export.export import CONTROL, FORMATS, export
from ocp_torch.export.lowering import lowered

__all__ = ["CONTROL", "FORMATS", "export", "lowered"]
