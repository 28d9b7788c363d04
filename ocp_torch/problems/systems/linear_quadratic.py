r"""Linear dynamics with a quadratic cost: the optimum on the whole space, and where a box changes nothing of it."""

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ocp_torch.problems.systems.rest import optimal_contraction, riccati

# Step along a path, as a part of 1 over the norm of the closed loop's matrix.
STEP = 2.0**-8
# Steps of a path, at most.
MOST_STEPS = 2**14


@dataclass(frozen=True)
class LinearQuadratic:
    r"""`rho E int e^{-rho t} (s'Qs + |v|^2) / 2 dt`, `ds = (A s + B v) dt + sigma dW`; ``diffusion`` is `sigma sigma' / 2`.

    ``A``, ``Q`` and ``diffusion`` are ``(d, d)``, ``B`` ``(d, m)``, all float64.
    """

    A: Tensor
    B: Tensor
    Q: Tensor
    diffusion: Tensor
    rho: float

    @cached_property
    def P(self) -> Tensor:
        """The solution of the discounted Riccati equation, ``(d, d)``."""
        return riccati(self.A, self.B, self.Q, self.rho)

    @cached_property
    def constant(self) -> float:
        """`tr(P D)`, what the noise costs: `D : hess V / rho`."""
        return float((self.P * self.diffusion).sum())

    def value(self, s: Tensor) -> Tensor:
        """`V(s) = rho s'Ps / 2 + tr(P D)`, ``(N,)``."""
        return 0.5 * self.rho * ((s @ self.P.to(s)) * s).sum(dim=-1) + self.constant

    def control(self, s: Tensor) -> Tensor:
        """`v = -B'Ps`, ``(N, m)``."""
        return -s @ (self.P @ self.B).to(s)

    @property
    def contraction(self) -> float:
        """The rate at which the optimal flow loses volume."""
        return optimal_contraction(self.A, self.B, self.Q, self.rho)

    def stays(self, half: Tensor, box: Tensor, limit: float = torch.inf) -> bool:
        """Whether without noise every path from the rectangle `|s_i| <= half_i` stays within ``box`` (both ``(d,)``) and
        `|v| <= limit`. Paths of the corners decide, as all sets are convex; once all corners are back in the rectangle, the
        argument repeats."""
        closed = (self.A - self.B @ self.B.T @ self.P) * box / box.unsqueeze(-1)  # the closed loop in units of the box
        gain = (self.B.T @ self.P) * box
        rates = [float(torch.linalg.matrix_norm(M, torch.inf)) for M in (closed, gain)]
        flow = torch.linalg.matrix_exp(closed * (STEP / rates[0])).T
        signs = [torch.tensor([-1.0, 1.0], dtype=torch.float64)] * len(half)
        s = torch.cartesian_prod(*signs).reshape(-1, len(half)) * (half / box)
        for _ in range(MOST_STEPS):
            # Between two steps no coordinate moves by more than this.
            moved = 2.0 * STEP * float(s.abs().max())
            control = float((s @ gain.T).norm(dim=-1).max()) + moved * rates[1] * len(gain) ** 0.5
            if float(s.abs().max()) + moved > 1.0 or control > limit:
                return False
            s = s @ flow
            if bool((s.abs() * box <= half).all()):
                return True
        return False
