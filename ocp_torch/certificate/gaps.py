"""How far two sides of a certificate are apart: relative to the lower one, and of what control can gain."""

import math

# A side of a gap: the name of the bound, and the far end of its interval.
Side = tuple[str, float]


def relative_gap(lower: Side | None, upper: Side | None) -> float | None:
    """The gap relative to the lower bound; `None` where that is not positive, or where errors make the two sides cross."""
    if lower is None or upper is None or lower[1] <= 0.0 or upper[1] < lower[1]:
        return None
    return (upper[1] - lower[1]) / lower[1]


def share(lower: Side | None, upper: Side | None, zero: float | None) -> float | None:
    """`1 - (upper - lower) / (zero - lower)`, for ``zero`` the least that doing nothing may cost; `None` where unknown."""
    if lower is None or upper is None or zero is None or upper[1] < lower[1]:
        return None
    gain = zero - lower[1]
    return 1.0 - (upper[1] - lower[1]) / gain if gain > 0.0 and math.isfinite(gain) else None
