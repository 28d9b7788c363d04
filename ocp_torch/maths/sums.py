"""Sums of tensors: to a type checker `sum` of a list may be the integer 0."""

import operator
from collections.abc import Iterable
from functools import reduce

from torch import Tensor


def summed(parts: Iterable[Tensor]) -> Tensor:
    """The sum of one tensor or more, from the first on."""
    return reduce(operator.add, parts)
