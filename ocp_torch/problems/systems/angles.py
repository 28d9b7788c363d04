"""Angles on the torus: a coordinate is a turn, a physical angle is in radians."""

import math

from torch import Tensor

TURN = 2.0 * math.pi


def to_turns(radians: Tensor) -> Tensor:
    """Any angles in radians as coordinates in [0, 1)."""
    return (radians / TURN).remainder(1.0)


def to_radians(turns: Tensor) -> Tensor:
    """Any coordinates as angles in [-pi, pi)."""
    return ((turns + 0.5).remainder(1.0) - 0.5) * TURN
