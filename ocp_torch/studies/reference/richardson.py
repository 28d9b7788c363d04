"""From the numbers of three grids: the extrapolated one, the order they show, and the error that is stated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

# Order of the scheme where V is smooth, by which the leading error is removed.
ORDER = 2.0
# Factor on the change of the extrapolated number from one pair of grids to the next: covers every order from 1 on.
SAFETY = 3.0
# What is removed by extrapolation counts as uncertain by this share at least, times SAFETY.
DOUBT = 0.1
# Orders that are looked for: no scheme has one outside.
ORDERS = (1e-3, 12.0)
# Numbers that differ by less, relative to their size, are the same.
ROUNDING = 1e-10


@dataclass(frozen=True)
class Extrapolation:
    """``optimum`` with its stated ``error``, and the ``order`` the three grids show (NaN where they show none: the error is
    then unknown, `None`)."""

    optimum: float
    error: float | None
    order: float


def extrapolate(spacings: Sequence[float], numbers: Sequence[float], noise: float = 0.0) -> Extrapolation:
    r"""Richardson's extrapolation of ``numbers`` on grids of ``spacings`` `h_1 > h_2 > h_3`, taken as `Q + C h^2`.

    With `X_12`, `X_23` from the two pairs of grids and `Q_3` the finest number the stated error is
    `SAFETY max(|X_23 - X_12|, DOUBT |X_23 - Q_3|)`. If the error is `C h^p` instead, that of `X_23` is below it for every
    `p` in [1, 2) and ratio of spacings from 4/3 on, and also for `p > 2`.

    Numbers that show no order say nothing about what they approach, unless all agree within ``noise``, their own error.
    """
    (h1, h2, h3), (Q1, Q2, Q3) = spacings, numbers
    pair = lambda coarse, fine, h, k: fine + (fine - coarse) / ((h / k) ** ORDER - 1.0)
    earlier, optimum = pair(Q1, Q2, h1, h2), pair(Q2, Q3, h2, h3)
    error = SAFETY * max(abs(optimum - earlier), DOUBT * abs(optimum - Q3))
    order = observed_order(spacings, numbers)
    settled = max(numbers) - min(numbers) <= noise + ROUNDING * max(map(abs, numbers))
    return Extrapolation(optimum, error if settled or not math.isnan(order) else None, order)


def observed_order(spacings: Sequence[float], numbers: Sequence[float]) -> float:
    """`p` with `(Q_1 - Q_2) / (Q_2 - Q_3) = (h_1^p - h_2^p) / (h_2^p - h_3^p)`, which increases in `p`; NaN if there is none
    between `ORDERS`, as where the changes have opposite signs."""
    from scipy.optimize import brentq

    (h1, h2, h3), (Q1, Q2, Q3) = spacings, numbers
    if Q2 == Q3 or not (Q1 - Q2) / (Q2 - Q3) > 0.0:
        return math.nan
    ratio = (Q1 - Q2) / (Q2 - Q3)
    excess = lambda p: (h1**p - h2**p) / (h2**p - h3**p) - ratio
    low, high = ORDERS
    return brentq(excess, low, high) if excess(low) < 0.0 < excess(high) else math.nan
