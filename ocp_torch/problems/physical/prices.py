"""Prices and limits of physical controls `u`, converted to the controls `v_i = r_i^{1/q} u_i` of the torus problem."""

import math
from collections.abc import Sequence

from ocp_torch.errors import InputError, require_number, require_numbers
from ocp_torch.problems.constant_noise import one_or_each


def positive_each(name: str, value: object, count: int) -> list[float]:
    """``value`` of the field ``name``, one number above 0 or ``count`` of them, as a list of ``count``; else `InputError`."""
    return [require_number(name, one, above=0.0) for one in one_or_each(name, value, count)]


def weight_roots(weight: object, count: int, exponent: float) -> list[float]:
    """`r_i^{1/q}` of each of ``count`` controls; `InputError` for weights that differ where `q` is not 2."""
    each = positive_each("problem.control_weight", weight, count)
    if exponent != 2.0 and min(each) != max(each):
        raise InputError(
            f"problem.control_weight is {weight}, but must be the same for all controls with problem.exponent = "
            f"{exponent:g}; with exponent 2 each may have its own."
        )
    return [value ** (1.0 / exponent) for value in each]


def scaled_limit(limit: object, roots: list[float]):
    """The ``limit`` on `u` as a limit on `v = roots u`; `InputError` for one number where the roots differ."""
    if limit is None:
        return None
    if isinstance(limit, Sequence) and not isinstance(limit, str):
        each = require_numbers("problem.control_limit", limit, len(roots), above=0.0)
        return [c * root for c, root in zip(each, roots, strict=True)]
    number = require_number("problem.control_limit", limit, above=0.0)
    if not math.isclose(min(roots), max(roots)):
        raise InputError(
            f"problem.control_limit is {number:g}, a limit on |u|, but the weights of the controls differ; give a list of "
            f"{len(roots)} limits, one for each control."
        )
    return number * roots[0]
