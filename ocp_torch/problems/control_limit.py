r"""A limit on the size of the control, `|u| <= c`, as a control cost: `R_c(u) = |u|^q / q` within the ball, infinite outside.

The paper's Corollary 1 allows any compact control set. What changes against `PowerCost`: the conjugate is linear beyond
`|p| = c^{q-1}`, where its maximiser reaches the limit; and since `mu R_c(w / mu)` is finite for `mu >= |w| / c` only, both
pointwise minimisers over `mu` are clipped from below there (the functions they minimise are convex in `mu`).
"""

import math

import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.maths.jets import Field
from ocp_torch.problems.control_cost import PowerCost, norm_power

# How far, relative to the limit, rounding may carry a control beyond it: in double, and in any other precision.
ROOM, COARSE_ROOM = 1e-9, 1e-4
# Limits whose powers up to the second, and one over them, stay far from the ends of single precision.
SMALLEST, LARGEST = 1e-9, 1e9


class LimitedCost(PowerCost):
    r"""`R_c(u) = |u|^q / q` for `|u| <= c`, else infinity; `R_c*(p) = R*(p)` up to `|p| = c^{q-1}`, then `c |p| - c^q / q`.

    ``limit`` is `c > 0`, in units of the control. Raises `InputError` for a limit or an exponent out of range.
    """

    def __init__(self, exponent: float, limit: float) -> None:
        super().__init__(exponent)
        self.limit = require_number("problem.control_limit", limit, above=0.0, at_least=SMALLEST, at_most=LARGEST)
        self.knee = self.limit ** (self.q - 1.0)  # where |grad R*(p)| reaches the limit
        self.largest = self.limit**self.q / self.q  # R at the limit

    def cost(self, u: Tensor) -> Tensor:
        allowed = norm_power(u.detach(), 1.0) <= self.limit * (1.0 + _room(u))
        return torch.where(allowed, super().cost(u), math.inf)

    def conjugate(self, p: Tensor) -> Tensor:
        size = norm_power(p, 1.0)
        inside = size <= self.knee
        # The power of a large |p| overflows, and would spoil the gradient from the branch that is not taken.
        near = super().conjugate(torch.where(inside.unsqueeze(-1), p, 0.0))
        return torch.where(inside, near, self.limit * size - self.largest)

    def argmax(self, p: Tensor) -> Tensor:
        size = norm_power(p, 1.0).unsqueeze(-1)
        inside = size <= self.knee
        near = super().argmax(torch.where(inside, p, 0.0))
        return torch.where(inside, near, self.limit * p / torch.where(inside, 1.0, size))

    def perspective(self, w: Tensor, mu: Tensor) -> Tensor:
        """`mu R_c(w / mu)`: infinite where `|w| > c mu`, beyond rounding, so also where `mu = 0` and `w != 0`."""
        allowed = norm_power(w.detach(), 1.0) <= self.limit * (1.0 + _room(w)) * mu.detach()
        # Only what is allowed goes in: an infinite cost would spoil the gradients of the branch that is not taken.
        inside = super().perspective(torch.where(allowed.unsqueeze(-1), w, 0.0), mu)
        return torch.where(allowed, inside, math.inf)

    def within(self, w: Tensor, mu: Tensor | float) -> Tensor:
        size = norm_power(w, 1.0)
        room = self.limit * mu
        scale = torch.where(size > room, room / torch.where(size > 0.0, size, 1.0), 1.0)
        return w * scale.unsqueeze(-1)

    def admissible(self, control_density: Field, occupation: Field) -> Field:
        """`w` shrunk to `|w| <= c mu`, state by state. Everything that is made of `w` is made of this field, its divergence
        too: `J` is then finite and a bound for whatever two networks say, and its gradients reach both of them."""
        return lambda x: self.within(control_density(x), occupation(x))

    def primal_occupation(self, w: Tensor, f: Tensor, value_bound: float, residual: Tensor) -> Tensor:
        """The minimiser of Lemma 2, but at least `|w| / c`."""
        return torch.maximum(super().primal_occupation(w, f, value_bound, residual), norm_power(w, 1.0) / self.limit)

    def primal_minimum(self, w: Tensor, f: Tensor, value_bound: float, residual: Tensor) -> Tensor:
        least = norm_power(w, 1.0) / self.limit
        clipped = super().primal_occupation(w.detach(), f, value_bound, residual.detach()) < least
        at_limit = least * (f + self.largest) + value_bound * (residual - least).clamp_min(0.0)
        return torch.where(clipped, at_limit, super().primal_minimum(w, f, value_bound, residual))

    def saddle_occupation(self, w: Tensor, beta: Tensor, occupation_bound: float) -> Tensor:
        """The minimiser of Lemma 3, but at least `|w| / c`; `M` where even that is too little for `w`."""
        least = (norm_power(w, 1.0) / self.limit).clamp_max(occupation_bound)
        return torch.maximum(super().saddle_occupation(w, beta, occupation_bound), least)

    def saddle_minimum(self, w: Tensor, beta: Tensor, occupation_bound: float) -> Tensor:
        """As in Lemma 3 over `[|w| / c, M]`, and infinite where that is empty: hand in ``within(w, M)``."""
        least = norm_power(w, 1.0) / self.limit
        clipped = super().saddle_occupation(w.detach(), beta.detach(), occupation_bound) < least
        at_limit = least * (beta + self.largest)
        found = torch.where(clipped, at_limit, super().saddle_minimum(w, beta, occupation_bound))
        return torch.where(least > occupation_bound * (1.0 + _room(w)), math.inf, found)


def _room(like: Tensor) -> float:
    return ROOM if like.dtype == torch.float64 else COARSE_ROOM


def control_cost(exponent: float, limit: float | None = None) -> PowerCost:
    """`R` of this exponent, within ``limit`` if there is one."""
    return PowerCost(exponent) if limit is None else LimitedCost(exponent, limit)
