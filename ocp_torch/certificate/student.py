r"""Quantiles of Student's t distribution, for confidence intervals from a few independent replicates."""

from __future__ import annotations

import math
from functools import cache

from ocp_torch.errors import require_integer, require_number


def central_probability(angle: float, degrees: int) -> float:
    r"""`P(|T| <= t)` for ``degrees`` `n` of freedom, at ``angle`` `= arctan(t / sqrt n)` in `[0, pi/2]`.

    The finite sums of Abramowitz and Stegun 26.7.3 and 26.7.4: exact for whole `n`.
    """
    sine, cosine = math.sin(angle), math.cos(angle)
    odd = degrees % 2
    term = total = (cosine if degrees > 1 else 0.0) if odd else 1.0
    for k in range(2 + odd, degrees - 1, 2):
        term *= (k - 1) / k * cosine**2
        total += term
    return 2.0 / math.pi * (angle + sine * total) if odd else sine * total


@cache
def t_factor(level: float, degrees: int) -> float:
    """The `t` with `P(|T| <= t) = level`: standard errors on each side of a mean of ``degrees + 1`` replicates.

    Raises `InputError` unless ``level`` is in (0, 1) and ``degrees`` at least 1.
    """
    require_number("level", level, above=0.0, at_most=1.0 - 1e-9)
    require_integer("degrees", degrees, 1)
    low, high = 0.0, 0.5 * math.pi
    while True:
        middle = 0.5 * (low + high)
        if middle in (low, high):
            return math.sqrt(degrees) * math.tan(high)
        if central_probability(middle, degrees) < level:
            low = middle
        else:
            high = middle
