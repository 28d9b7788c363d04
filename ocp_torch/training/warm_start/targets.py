"""What a round of the warm start fits a `V` to."""

from typing import NamedTuple

from torch import Tensor


class Targets(NamedTuple):
    """States ``(N, d)``, what `V` is to be there, and about what it is, in which chance has no part, both ``(N,)``."""

    x: Tensor
    y: Tensor
    values: Tensor
