"""How far apart two sides are: gaps, and the part of what control can gain that is certainly achieved."""

from __future__ import annotations

import math
from collections.abc import Callable

# A side of a gap: the name of the bound, and the far end of its interval.
Side = tuple[str, float]


def best(choose: Callable, ends: dict[str, float]) -> Side | None:
    """Of ``ends`` of intervals by name the one that ``choose``, `min` or `max`, takes; `None` where there are none."""
    if not ends:
        return None
    name = choose(ends, key=ends.get)
    return name, ends[name]


def relative_gap(lower: Side | None, upper: Side | None) -> float | None:
    """Relative to the lower bound; `None` where that is not positive, or where the two cross, as errors may make them."""
    if lower is None or upper is None or lower[1] <= 0.0 or upper[1] < lower[1]:
        return None
    return (upper[1] - lower[1]) / lower[1]


def share(lower: Side | None, upper: Side | None, zero: float | None) -> float | None:
    """`1 - (upper - lower) / (zero - lower)`, for ``zero`` the least that doing nothing may cost; `None` where unknown."""
    if lower is None or upper is None or zero is None or upper[1] < lower[1]:
        return None
    gain = zero - lower[1]
    return 1.0 - (upper[1] - lower[1]) / gain if gain > 0.0 and math.isfinite(gain) else None
