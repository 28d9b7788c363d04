"""Noise that is the same at every state: the numbers a user gives, checked."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number, require_numbers


def one_or_each(name: str, value: object, count: int) -> list[float]:
    """``value``, one number or ``count`` of them, as a list of ``count``; raises `InputError` for anything else, and for
    negative ones. ``name`` is the field's."""
    if isinstance(value, Sequence) and not isinstance(value, str):
        each = require_numbers(name, value, count)
    else:
        each = [require_number(name, value)] * count
    if min(each) < 0.0:
        raise InputError(f"{name} is {value}, but must be 0 or more.")
    return each


def constant_diffusion(noise: object, dim: int) -> tuple[float, ...] | None:
    """The field ``noise`` of a problem as the diagonal of `D`; `None` where all of it is 0. Raises `InputError` unless it is
    a number `>= 0`, or ``dim`` of them."""
    each = one_or_each("problem.noise", noise, dim)
    return tuple(each) if max(each) > 0.0 else None


def column_matrix(diffusion: tuple[float, ...] | None) -> Tensor | None:
    """`sigma` ``(d, d)`` of the diagonal ``diffusion`` of `D = sigma sigma^T / 2`; `None` for no noise."""
    return None if diffusion is None else torch.tensor(diffusion, dtype=torch.float64).mul(2.0).sqrt().diag()
