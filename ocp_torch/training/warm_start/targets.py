"""What a round of the warm start fits a `V` to."""

from typing import NamedTuple

from torch import Tensor


class Targets(NamedTuple):
    """States ``x`` ``(N, d)``; the targets ``y`` of `V` there, and ``values`` near them without random parts, both ``(N,)``;
    and its gradients ``(N, d)``, where known."""

    x: Tensor
    y: Tensor
    values: Tensor
    gradients: Tensor | None = None
