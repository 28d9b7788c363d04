"""Angles on the torus: a coordinate is a turn, a physical angle is in radians; and a bump that obstacles cost."""

from __future__ import annotations

import math

from torch import Tensor

TURN = 2.0 * math.pi


def to_turns(radians: Tensor) -> Tensor:
    """Any angles in radians as coordinates in [0, 1)."""
    return (radians / TURN).remainder(1.0)


def to_radians(turns: Tensor) -> Tensor:
    """Any coordinates as angles in [-pi, pi)."""
    return ((turns + 0.5).remainder(1.0) - 0.5) * TURN


def bump(square: Tensor, reach: Tensor | float) -> Tensor:
    """`max(1 - r^2 / reach^2, 0)^3` of a ``square`` distance `r^2`: 1 at the centre, 0 from ``reach`` on."""
    return (1.0 - square / reach**2).clamp_min(0.0) ** 3
