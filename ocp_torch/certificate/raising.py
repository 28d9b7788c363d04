"""An `M` that nobody gave follows the occupation density of the learned controller."""

from __future__ import annotations

import math
from dataclasses import replace

from ocp_torch.bounds import ESTIMATED, OCCUPATION_GUESS, OCCUPATION_WEIGHT, Bounds

# Head-room of an M that is estimated from the learned controller's occupation density.
OCCUPATION_ROOM = 1.25


def raised(bounds: Bounds, sup_occupation: float | None) -> Bounds:
    """``bounds`` with an `M` that nobody gave raised above the occupation density met under the learned controller."""
    if bounds.sources["M"] != ESTIMATED or sup_occupation is None or not math.isfinite(sup_occupation):
        return bounds
    if bounds.unbounded:
        return bounds  # whatever was met, more is to be had
    M = OCCUPATION_ROOM * sup_occupation
    if M <= bounds.M:
        return bounds
    note = f"F_M uses M = {M:.4g}, {OCCUPATION_ROOM:g} times the occupation density met under the learned controller."
    return replace(bounds, M=M, warnings=(*bounds.warnings, note))


def retrained(bounds: Bounds, sup_occupation: float | None) -> Bounds:
    """What a further round trains with: ``bounds`` as `raised`, or, where the density has grown so large that no useful `M`
    bounds it, as `unbounded`."""
    if bounds.sources["M"] != ESTIMATED or sup_occupation is None or bounds.unbounded:
        return bounds
    # A guess is a multiple of sup mu0; so is the weight that training goes on with.
    weight = OCCUPATION_WEIGHT / OCCUPATION_GUESS * bounds.M
    if not math.isfinite(sup_occupation) or OCCUPATION_ROOM * sup_occupation > weight:
        note = f"the occupation density met reaches {sup_occupation:.4g}: from then on training aimed at the bound without M."
        return replace(bounds, M=weight, unbounded=True, warnings=(*bounds.warnings, note))
    return raised(bounds, sup_occupation)
