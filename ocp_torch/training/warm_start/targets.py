"""What a round of the warm start fits a `V` to."""

from typing import NamedTuple

from torch import Tensor


class Targets(NamedTuple):
    """States ``(N, d)``, what `V` is to be there, and about what it is, in which chance has no part, both ``(N,)``; and its
    gradient ``(N, d)``, where that is known as well."""

    x: Tensor
    y: Tensor
    values: Tensor
    gradients: Tensor | None = None
