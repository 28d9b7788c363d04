r"""The control cost `R` and everything that follows from it: conjugate, argmax, perspective, and the two pointwise
minimisers over the occupation density (Lemmas 2 and 3 of the paper).

Nobody else in the package branches on the form of `R`: another cost, a control limit for instance, is another class
with the same methods.
"""

import math

import torch
from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.maths.jets import Field


def power(base: Tensor, exponent: float) -> Tensor:
    """``base ** exponent`` for ``base >= 0``, with value and gradient 0 where ``base = 0`` (for ``exponent > 0``).

    Autograd alone gives infinity times zero there, a NaN, for exponents below 1. A zero exponent gives 1.
    """
    if exponent == 0.0:
        return torch.ones_like(base)
    if exponent == 1.0:
        return base
    positive = base > 0
    return torch.where(positive, torch.where(positive, base, 1.0) ** exponent, 0.0)


def norm_power(vectors: Tensor, exponent: float) -> Tensor:
    """Euclidean ``|v| ** exponent`` over the last axis, ``(N, m) -> (N,)``, safe in value and gradient at ``v = 0``.

    Rescaled by the largest entry, so that squares of small float32 numbers do not underflow.
    """
    scale = vectors.detach().abs().amax(dim=-1)
    scale = torch.where((scale > 0) & torch.isfinite(scale), scale, 1.0)
    squares = (vectors / scale.unsqueeze(-1)).square().sum(dim=-1)
    return power(squares, exponent / 2) * scale**exponent


def radial_part(p: Tensor, moved: Tensor) -> Tensor:
    """The part along ``p`` ``(N, m)`` of each column of ``moved`` ``(N, m, k)``; 0 where `p = 0`."""
    direction = torch.nn.functional.normalize(p, dim=-1, eps=1e-30).unsqueeze(-1)
    return direction * (direction * moved).sum(dim=1, keepdim=True)


class PowerCost:
    r"""`R(u) = |u|^q / q` with `q` in (1, 2] and the Euclidean norm; `R*(p) = |p|^{q'} / q'`, `1/q + 1/q' = 1`.

    Raises `InputError` when the exponent is outside (1, 2].

    Limits of the control: ``limit`` as the problem has it, ``reach`` the largest `|u|`, ``sides`` the largest `|u_i|`, a
    number or one for each `i`.
    """

    limit: float | list[float] | None = None
    reach: float = math.inf
    sides: float | list[float] = math.inf

    def __init__(self, exponent: float = 2.0) -> None:
        self.q = require_number("exponent", exponent, above=1.0, at_most=2.0)
        self.conjugate_exponent = self.q / (self.q - 1.0)
        # ((q-1)/q)^{1/q}: the factor of |w| c^{-1/q} in the minimiser of c mu + mu R(w/mu).
        self._free = ((self.q - 1.0) / self.q) ** (1.0 / self.q)
        # (q/(q-1))^{(q-1)/q}: the factor of c^{(q-1)/q} |w| in that minimum.
        self._slope = (self.q / (self.q - 1.0)) ** ((self.q - 1.0) / self.q)

    def cost(self, u: Tensor) -> Tensor:
        """`R(u)`: ``(N, m) -> (N,)``."""
        return norm_power(u, self.q) / self.q

    def conjugate(self, p: Tensor) -> Tensor:
        """`R*(p) = sup_u p.u - R(u)`: ``(N, m) -> (N,)``."""
        return norm_power(p, self.conjugate_exponent) / self.conjugate_exponent

    def argmax(self, p: Tensor) -> Tensor:
        """`grad R*(p) = |p|^{q'-2} p`, the control that attains the conjugate: ``(N, m) -> (N, m)``."""
        if self.q == 2.0:
            return p
        return norm_power(p, self.conjugate_exponent - 2.0).unsqueeze(-1) * p

    def argmax_along(self, p: Tensor, moved: Tensor) -> Tensor:
        r"""The derivative of `argmax` at ``p`` ``(N, m)`` along each column of ``moved`` ``(N, m, k)``: that column times
        `|p|^{q'-2} (I + (q'-2) n n^T)` with `n = p / |p|`."""
        power = self.conjugate_exponent - 2.0
        if power == 0.0:
            return moved
        return norm_power(p, power)[:, None, None] * (moved + power * radial_part(p, moved))

    def argmax_root(self, p: Tensor, moved: Tensor) -> Tensor:
        r"""The symmetric root of the derivative that `argmax_along` multiplies by, times ``moved`` ``(N, m, k)``."""
        power = self.conjugate_exponent - 2.0
        if power == 0.0:
            return moved
        radial = math.sqrt(1.0 + power) - 1.0
        return norm_power(p, 0.5 * power)[:, None, None] * (moved + radial * radial_part(p, moved))

    def perspective(self, w: Tensor, mu: Tensor) -> Tensor:
        """`mu R(w / mu)`, with its closure at `mu = 0`: 0 if `w = 0`, infinity otherwise; ``(N, m), (N,) -> (N,)``."""
        positive = mu > 0
        safe = torch.where(positive, mu, 1.0)
        # As mu R(w / mu), not as powers of mu alone: these overflow in the backward pass where mu is small.
        inside = safe * self.cost(w / safe.unsqueeze(-1))
        outside = torch.where((w != 0).any(dim=-1), math.inf, 0.0).to(mu)
        return torch.where(positive, inside, outside)

    def gauge(self, w: Tensor) -> Tensor:
        """The least `mu` ``(N,)`` for which the control ``w / mu`` is within the limit; 0 where there is no limit."""
        return torch.zeros_like(w[..., 0])

    def within(self, w: Tensor, mu: Tensor | float) -> Tensor:
        """The nearest to ``w`` ``(N, m)`` of the `w` that `mu` ``(N,)`` allows; ``w`` itself without a limit on `u`."""
        return w

    def admissible(self, control_density: Field, occupation: Field) -> Field:
        """The field ``control_density`` cut to what the field ``occupation`` allows; unchanged without a limit on `u`."""
        return control_density

    def primal_occupation(self, w: Tensor, f: Tensor, value_bound: float, residual: Tensor) -> Tensor:
        r"""The minimiser of `primal_minimum` over `mu >= 0` (Lemma 2); infinite where `f = 0` and `w != 0`.

        `max(c0 |w|, beta)` when `f <= C_V`; where `f > C_V` keeping mass is dearer than losing it, and the minimiser is
        `min(c1 |w|, beta)` with the cost `f - C_V` in place of `f`.
        """
        size = norm_power(w, 1.0)
        beta = residual.clamp_min(0.0)
        cheap = torch.maximum(self._free_minimiser(size, f), beta)
        dear = torch.minimum(self._free_minimiser(size, (f - value_bound).clamp_min(0.0)), beta)
        return torch.where(f > value_bound, torch.maximum(dear, self._free_minimiser(size, f)), cheap)

    def primal_minimum(self, w: Tensor, f: Tensor, value_bound: float, residual: Tensor) -> Tensor:
        r"""`min_{mu >= 0} f mu + mu R(w/mu) + C_V [beta - mu]_+` with `beta` the ``residual`` (Lemma 2); ``(N,)``.

        Differentiable in `w` and `beta` by the envelope theorem: 0 in `beta` on the free branch.
        """
        size = norm_power(w, 1.0)
        free = self._free_minimiser(size.detach(), f)
        on_free = residual <= free
        free_value = self._slope * f ** ((self.q - 1.0) / self.q) * size
        beta = torch.where(on_free, 1.0, residual)
        excess = f - value_bound
        partial = (excess > 0) & (beta > self._free_minimiser(size.detach(), excess.clamp_min(0.0)))
        bound_value = f * beta + self.perspective(w, beta)
        partial_value = value_bound * beta + self._slope * excess.clamp_min(0.0) ** ((self.q - 1.0) / self.q) * size
        return torch.where(on_free, free_value, torch.where(partial, partial_value, bound_value))

    def saddle_occupation(self, w: Tensor, beta: Tensor, occupation_bound: float) -> Tensor:
        r"""The minimiser of `saddle_minimum` over `mu` in `[0, M]` (Lemma 3); `M` where `beta <= 0`, also at `w = 0`."""
        free = self._free_minimiser(norm_power(w, 1.0), beta.clamp_min(0.0)).clamp_max(occupation_bound)
        return torch.where(beta > 0, free, torch.full_like(beta, occupation_bound))

    def saddle_minimum(self, w: Tensor, beta: Tensor, occupation_bound: float) -> Tensor:
        r"""`S_M(w, beta) = min_{0 <= mu <= M} beta mu + mu R(w/mu)` (Lemma 3); ``(N, m), (N,) -> (N,)``."""
        size = norm_power(w, 1.0)
        threshold = (self.q - 1.0) / self.q * norm_power(w.detach(), self.q) / occupation_bound**self.q
        on_bound = beta <= threshold
        bound_value = beta * occupation_bound + norm_power(w, self.q) / self.q * occupation_bound ** (1.0 - self.q)
        beta_free = torch.where(on_bound, 1.0, beta)
        return torch.where(on_bound, bound_value, self._slope * beta_free ** ((self.q - 1.0) / self.q) * size)

    def _free_minimiser(self, size: Tensor, c: Tensor) -> Tensor:
        """`argmin_{mu >= 0} c mu + mu R(w/mu)` for `|w| = size`: infinity where `c = 0` unless `size = 0`."""
        positive = c > 0
        finite = self._free * torch.where(positive, c, 1.0) ** (-1.0 / self.q) * size
        return torch.where(positive, finite, torch.where(size > 0, math.inf, 0.0).to(size))
