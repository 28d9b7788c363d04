"""Constant tensors in the precision and on the device of the states that they are used with."""

import torch
from torch import Tensor


class DeviceConstants:
    """Keeps a copy of its constant tensors for every precision and device that they were asked for in."""

    def _like(self, x: Tensor, name: str, constant: Tensor) -> Tensor:
        """``constant`` on the device of ``x`` and, unless it is of whole numbers, in its precision; converted once. ``name``
        must be different for each constant."""
        placed = vars(self).setdefault("_placed", {})
        key = (name, x.dtype, x.device)
        if key not in placed:
            with torch.inference_mode(False):  # the copy may be used in a graph later
                placed[key] = constant.to(x if constant.is_floating_point() else x.device)
        return placed[key]
