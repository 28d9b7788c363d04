"""Step sizes of the paper's experiments and theorems."""

from __future__ import annotations

import numpy as np

from ocp_torch.errors import require_choice, require_integer, require_number


def step_sizes(
    initial: float, count: int, kind: str = "constant", decay: float = 0.75, every: int = 20000, exponent: float = 0.5
) -> np.ndarray:
    """``initial`` times 1 (``constant``), ``decay`` to the number of whole ``every`` moves made (``decay``; the paper's 25 %
    every 20,000), `n^-exponent` throughout a run of `n` moves (``horizon``, Theorems 2 to 4) or `k^-exponent` at move `k`
    (``power``); ``(count,)``."""
    require_choice("kind", kind, ("constant", "decay", "horizon", "power"))
    require_number("initial", initial, above=0.0)
    moves = np.arange(1, require_integer("count", count, 1) + 1)
    factors = {
        "constant": lambda: np.ones(count),
        "decay": lambda: decay ** ((moves - 1) // every),
        "horizon": lambda: np.full(count, float(count) ** -exponent),
        "power": lambda: moves**-exponent,
    }
    return initial * factors[kind]()
