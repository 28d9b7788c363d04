"""A module as a user has it beside his commands: written into a test's folder, and named on command lines."""

import textwrap
import time
from pathlib import Path

MODULE = """
    import math, torch
    from ocp_torch import Problem

    class Pendula(Problem):
        def __init__(self, coupling: float = 0.3, discount: float = 3.5, control_limit: float | None = 0.7):
            super().__init__(dim=2, discount=discount, control_limit=control_limit)
            self.pull = 2.0 * coupling  # no attribute is called as the argument is

        def state_cost(self, x):
            return 0.5 * (1 - torch.cos(2 * math.pi * (x[:, 0] - x[:, 1])))

        def drift(self, x):
            push = 0.5 * self.pull * torch.sin(2 * math.pi * (x[:, 0] - x[:, 1]))
            return torch.stack([push, -push], dim=1)

    class Ageing(Problem):
        # Good for so many calls of its cost; with holes, for so many steps, which draw 12 of their 16 states.
        def __init__(self, calls: int, how: str):
            super().__init__(dim=1)
            self.left, self.calls, self.how = calls, calls, how

        def state_cost(self, x):
            if self.how != "holes" or (len(x) == 12 and x.dtype == torch.float32):
                self.left -= 1
            f = 1 + torch.cos(2 * math.pi * x[:, 0])
            if self.left >= 0:
                return f
            if self.how == "always":
                raise RuntimeError("licence expired\\nask your admin")
            if self.how == "somewhere" and (x[:, 0] > 0.9).any():
                raise ValueError("no such state")
            return torch.where(x[:, 0] > 0.9, math.nan, f) if self.how == "holes" else f

    class Wide(Problem):
        # The same problem in other units: cost times 4^-k, controls in units 2^k times as small.
        def __init__(self, k: int):
            super().__init__(dim=2)
            self.k = k

        def state_cost(self, x):
            return 4.0 ** -self.k * (1 + torch.cos(2 * math.pi * (x[:, 0] - x[:, 1])))

        def control_matrix(self, x):
            return 2.0**self.k * super().control_matrix(x)
"""


def write(folder: Path) -> str:
    """The module's name, new each time, for Python imports a name once."""
    name = f"own_{time.monotonic_ns()}"
    (folder / f"{name}.py").write_text(textwrap.dedent(MODULE))
    return name
