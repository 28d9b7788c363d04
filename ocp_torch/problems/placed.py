"""Constants where they are needed: in the precision and on the device of the states they meet."""

from torch import Tensor


class Placed:
    """Keeps constant tensors in every precision and on every device they were asked for."""

    def _like(self, x: Tensor, name: str, constant: Tensor) -> Tensor:
        """``constant`` in the precision and on the device of ``x``, converted once; ``name`` is its own."""
        placed = vars(self).setdefault("_placed", {})
        key = (name, x.dtype, x.device)
        if key not in placed:
            placed[key] = constant.to(x)
        return placed[key]
