"""An `M` that nobody gave follows the occupation density of the learned controller."""

from __future__ import annotations

import math
from dataclasses import replace

from ocp_torch.bounds import ESTIMATED, Bounds

# Head-room of an M that is estimated from the learned controller's occupation density.
OCCUPATION_ROOM = 1.25


def raised(bounds: Bounds, sup_occupation: float | None) -> Bounds:
    """``bounds`` with an `M` that nobody gave raised above the occupation density met under the learned controller."""
    if bounds.sources["M"] != ESTIMATED or sup_occupation is None or not math.isfinite(sup_occupation):
        return bounds
    M = OCCUPATION_ROOM * sup_occupation
    if M <= bounds.M:
        return bounds
    note = f"F_M uses M = {M:.4g}, {OCCUPATION_ROOM:g} times the occupation density met under the learned controller."
    return replace(bounds, M=M, warnings=(*bounds.warnings, note))
