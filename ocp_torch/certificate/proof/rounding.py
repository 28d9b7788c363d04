"""What rounding in float64 can change, and radii that leave room for it."""

from __future__ import annotations

from torch import Tensor

# Rounding of one operation on models, relative to the sum of the absolute values of what it adds up: an operation does
# fewer than 256 roundings of 2^-53 on any path, and gamma_256 < 2^-44 (Higham, Accuracy and Stability of Numerical
# Algorithms, section 3.1). Library functions are assumed to be accurate to 16 units in the last place.
ROUNDING = 2.0**-44
# A radius is a short sum of products of numbers >= 0. The first number makes up for the rounding of that sum itself, the
# second for underflow.
UPWARD, SMALLEST = 1.0 + 2.0**-40, 1e-290


def upward(radius: Tensor) -> Tensor:
    """``radius``, a sum of products of numbers >= 0, with room for the rounding of its own computation."""
    return radius * UPWARD + SMALLEST
