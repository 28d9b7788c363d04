r"""Limits on the control as control costs: `R_K(u) = |u|^q / q` within a convex set `K` of controls, and infinite outside.

The paper's Corollary 1 allows any compact set. What changes against `PowerCost`: the conjugate is linear where its maximiser
is at the limit; and since `mu R_K(w / mu)` is finite for `w` in `mu K` only, both pointwise minimisers over `mu` are clipped
from below there (the functions they minimise are convex in `mu`). Two methods define `K`: `gauge`, the least `mu` with `w` in
`mu K`, and `within`, the point of `mu K` nearest to `w`.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number, require_numbers, shown
from ocp_torch.maths.jets import Field
from ocp_torch.problems.control_cost import PowerCost, norm_power, radial_part
from ocp_torch.problems.device_constants import DeviceConstants

# The largest `|u|`, or a list of the largest `|u_i|`; `None` where there is no limit.
Limit = float | Sequence[float] | None
# How far, relative to the limit, rounding may carry a control beyond it in double precision.
ROOM = 1e-9
# The same in any other precision.
COARSE_ROOM = 1e-4
# Range of limits: their squares, and one over these, stay far from the ends of single precision.
SMALLEST_LIMIT = 1e-9
LARGEST_LIMIT = 1e9


class ConstrainedCost(PowerCost):
    """`R_K` for a subclass that defines `K` by `gauge` and `within`. At `p` within ``bend`` times `K` the conjugate is `R*`;
    at any other `p` the maximiser is that at the nearest point of this set."""

    bend = 1.0

    def cost(self, u: Tensor) -> Tensor:
        return torch.where(self.gauge(u.detach()) <= 1.0 + _room(u), super().cost(u), math.inf)

    def conjugate(self, p: Tensor) -> Tensor:
        near = self.within(p, self.bend)  # the power of a larger p would overflow
        return super().conjugate(near) + (super().argmax(near) * (p - near)).sum(dim=-1)

    def argmax(self, p: Tensor) -> Tensor:
        u = super().argmax(self.within(p, self.bend))
        return u if self.q == 2.0 else self.within(u, 1.0)  # rounding in the power may lead beyond the limit

    def perspective(self, w: Tensor, mu: Tensor) -> Tensor:
        """`mu R_K(w / mu)`: infinite where `w` is not in `mu K`, beyond rounding, so also where `mu = 0` and `w != 0`."""
        allowed = self.gauge(w.detach()) <= (1.0 + _room(w)) * mu.detach()
        # Zeros in place of what is not allowed: an infinite cost there would make gradients NaN.
        inside = super().perspective(torch.where(allowed.unsqueeze(-1), w, 0.0), mu)
        return torch.where(allowed, inside, math.inf)

    def admissible(self, control_density: Field, occupation: Field) -> Field:
        """`w` cut to `mu K`, state by state. As all that follows, divergences too, is made of this field, `J` is finite and a
        bound for any two networks, and its gradients reach both of them."""
        return lambda x: self.within(control_density(x), occupation(x))

    def primal_occupation(self, w: Tensor, f: Tensor, value_bound: float, residual: Tensor) -> Tensor:
        """The minimiser of Lemma 2, but at least the gauge of `w`."""
        return torch.maximum(super().primal_occupation(w, f, value_bound, residual), self.gauge(w))

    def primal_minimum(self, w: Tensor, f: Tensor, value_bound: float, residual: Tensor) -> Tensor:
        least = self.gauge(w)
        clipped = super().primal_occupation(w.detach(), f, value_bound, residual.detach()) < least
        at_limit = least * f + self._at_limit(w) + value_bound * (residual - least).clamp_min(0.0)
        return torch.where(clipped, at_limit, super().primal_minimum(w, f, value_bound, residual))

    def saddle_occupation(self, w: Tensor, beta: Tensor, occupation_bound: float) -> Tensor:
        """The minimiser of Lemma 3, but at least the gauge of `w`; `M` where even that is too little for `w`."""
        least = self.gauge(w).clamp_max(occupation_bound)
        return torch.maximum(super().saddle_occupation(w, beta, occupation_bound), least)

    def saddle_minimum(self, w: Tensor, beta: Tensor, occupation_bound: float) -> Tensor:
        """The minimum of Lemma 3 over `mu` from the gauge of `w` to `M`; infinite where the gauge is above `M`, so that
        callers hand in ``within(w, M)``."""
        least = self.gauge(w)
        clipped = super().saddle_occupation(w.detach(), beta.detach(), occupation_bound) < least
        at_limit = least * beta + self._at_limit(w)
        found = torch.where(clipped, at_limit, super().saddle_minimum(w, beta, occupation_bound))
        return torch.where(least > occupation_bound * (1.0 + _room(w)), math.inf, found)

    def _at_limit(self, w: Tensor) -> Tensor:
        """`mu R(w / mu)` at the least `mu`, ``(N,)``; `w` is scaled by its largest entry, lest squares underflow."""
        size = w.detach().abs().amax(dim=-1)
        size = torch.where(size > 0.0, size, 1.0)
        w = w / size.unsqueeze(-1)
        return size * self.perspective(w, self.gauge(w))


class LimitedCost(ConstrainedCost):
    r"""`R_c(u) = |u|^q / q` for `|u| <= c`, else infinity; `R_c*(p) = R*(p)` up to `|p| = c^{q-1}`, then `c |p| - c^q / q`.

    ``limit`` is `c > 0`, in units of the control. Raises `InputError` for a limit or an exponent out of range.
    """

    limit: float

    def __init__(self, exponent: float, limit: float) -> None:
        super().__init__(exponent)
        self.limit = self.reach = self.sides = _size("problem.control_limit", limit)
        self.bend = self.limit ** (self.q - 2.0)
        self.knee = self.limit ** (self.q - 1.0)  # where |grad R*(p)| reaches the limit
        self.largest = self.limit**self.q / self.q  # R at the limit

    def gauge(self, w: Tensor) -> Tensor:
        return norm_power(w, 1.0) / self.limit

    def within(self, w: Tensor, mu: Tensor | float) -> Tensor:
        size, room = norm_power(w, 1.0), self.limit * mu
        beyond = size > room
        # A quotient by a tiny size would overflow in the branch that is not taken, and make the gradient NaN.
        scale = torch.where(beyond, room / torch.where(beyond, size, 1.0), 1.0)
        return w * scale.unsqueeze(-1)

    def argmax_along(self, p: Tensor, moved: Tensor) -> Tensor:
        """`PowerCost.argmax_along`, but `(c / |p|) (I - n n^T)` at the limit, where only the direction of `u` changes."""
        at_limit, factor = self._turning(p)
        return torch.where(at_limit, factor * (moved - radial_part(p, moved)), super().argmax_along(p, moved))

    def argmax_root(self, p: Tensor, moved: Tensor) -> Tensor:
        at_limit, factor = self._turning(p)
        return torch.where(at_limit, factor.sqrt() * (moved - radial_part(p, moved)), super().argmax_root(p, moved))

    def _turning(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """Whether `argmax` is at the limit, and `c / |p|` there; ``(N, 1, 1)``."""
        size = norm_power(p, 1.0)[:, None, None]
        at_limit = size > self.knee
        return at_limit, self.limit / torch.where(at_limit, size, 1.0)

    def _at_limit(self, w: Tensor) -> Tensor:
        return self.gauge(w) * self.largest


class BoxLimitedCost(ConstrainedCost, DeviceConstants):
    r"""`R_c(u) = |u|^2 / 2` for `|u_i| <= c_i`, else infinity: a sum over the actuators, as is its conjugate, of Huber's
    functions `R_{c_i}*(p_i)`; but the actuators share `mu`, which is at least `max_i |w_i| / c_i`.

    ``limit`` is the list of the `c_i > 0`, in units of the controls, ``count`` of them where that is known. Raises
    `InputError` for any other list, and for an exponent other than 2, with which the cost is no sum.
    """

    limit: list[float]

    def __init__(self, exponent: float, limit: Sequence[float], count: int | None = None) -> None:
        super().__init__(exponent)
        if self.q != 2.0:
            raise InputError(
                f"problem.control_limit is {shown(limit)}, a limit for each actuator, but problem.exponent is {self.q:g}; "
                "that goes with problem.exponent=2 alone, and one number limits |u| with any."
            )
        names = (f"problem.control_limit[{i}]" for i in range(len(limit)))
        numbers = require_numbers("problem.control_limit", limit, count)
        self.limit = self.sides = [_size(name, c) for name, c in zip(names, numbers, strict=True)]
        self._sides = torch.tensor(self.limit, dtype=torch.float64)
        self.reach = math.hypot(*self.limit)

    def gauge(self, w: Tensor) -> Tensor:
        return (w.abs() / self._like(w, "sides", self._sides)).amax(dim=-1)

    def within(self, w: Tensor, mu: Tensor | float) -> Tensor:
        room = self._like(w, "sides", self._sides) * (mu.unsqueeze(-1) if isinstance(mu, Tensor) else mu)
        return w.clamp(-room, room)

    def argmax_along(self, p: Tensor, moved: Tensor) -> Tensor:
        """The derivative of `argmax`: that of ``moved`` itself, and 0 for entries at their limit."""
        return torch.where((p.abs() > self._like(p, "sides", self._sides)).unsqueeze(-1), 0.0, moved)

    argmax_root = argmax_along  # a matrix of ones and zeros


def _size(name: str, limit: object) -> float:
    return require_number(name, limit, above=0.0, at_least=SMALLEST_LIMIT, at_most=LARGEST_LIMIT)


def _room(like: Tensor) -> float:
    return ROOM if like.dtype == torch.float64 else COARSE_ROOM


def control_cost(exponent: float, limit: Limit = None, count: int | None = None) -> PowerCost:
    """`R` of this exponent, within ``limit`` if there is one: a number, or a list of one for each of ``count`` actuators."""
    if limit is None:
        return PowerCost(exponent)
    if isinstance(limit, Sequence) and not isinstance(limit, str):
        return BoxLimitedCost(exponent, limit, count)
    return LimitedCost(exponent, limit)
