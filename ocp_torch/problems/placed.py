"""Constants where they are needed: in the precision and on the device of the states they meet."""

import torch
from torch import Tensor


class Placed:
    """Keeps constant tensors in every precision and on every device they were asked for."""

    def _like(self, x: Tensor, name: str, constant: Tensor) -> Tensor:
        """``constant`` on the device of ``x`` and, unless it is of whole numbers, in its precision; converted once. ``name``
        is its own."""
        placed = vars(self).setdefault("_placed", {})
        key = (name, x.dtype, x.device)
        if key not in placed:
            with torch.inference_mode(False):  # what is kept may meet a graph later
                placed[key] = constant.to(x if constant.is_floating_point() else x.device)
        return placed[key]
