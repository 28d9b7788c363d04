"""Whether two states are the same to the bit."""

from __future__ import annotations

import torch


def differences(one, other, where: str = "") -> list[str]:
    """Where two nested states differ by as much as a bit."""
    if isinstance(one, torch.Tensor):
        same = one.dtype == other.dtype and torch.equal(one, other)
        return [] if same else [where]
    if isinstance(one, dict):
        if one.keys() != other.keys():
            return [where]
        return [d for k in one for d in differences(one[k], other[k], f"{where}/{k}")]
    if isinstance(one, list | tuple):
        if len(one) != len(other):
            return [where]
        return [d for k, pair in enumerate(zip(one, other, strict=True)) for d in differences(*pair, f"{where}/{k}")]
    return [] if one == other else [where]
