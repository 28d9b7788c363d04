"""Functions of the state for where there is no PyTorch: ONNX, C99 and CasADi."""

from ocp_torch.export.export import CONTROL, FORMATS, export
from ocp_torch.export.lowering import lowered

__all__ = ["CONTROL", "FORMATS", "export", "lowered"]
