r"""A kinked problem with exact truth in any dimension: independent circles, seen through a shear of the torus."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import require_choice, require_integer
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.problem import Problem

SHEARS = ("none", "chain", "random")
# rho and d k that differ by less, relative to rho, count as equal: the formula of mu* is then 0 / 0.
CRITICAL = 1e-9


def shear_matrix(dim: int, shear: str, seed: int) -> Tensor:
    """An integer matrix of determinant 1: the identity; each coordinate plus the one before; or a random product."""
    A = torch.eye(dim, dtype=torch.float64)
    if shear == "chain":
        A[range(1, dim), range(dim - 1)] = 1.0
    if shear == "random" and dim > 1:
        generator = torch.Generator().manual_seed(seed)
        for _ in range(dim):
            target, source = torch.randperm(dim, generator=generator)[:2].tolist()
            sign = 2 * int(torch.randint(2, (), generator=generator)) - 1
            A[target] += sign * A[source]
    return A


class Torus(Problem):
    r"""`f(x) = (1/d) sum_i (y_i - 1/2)^2` with `y = A x mod 1` and `B = A^{-1}`, so that `dy/dt = u`; `q = 2`.

    With `alpha = (sqrt(1 + 8/(d rho^2)) - 1) rho^2 / 4`: `V* = alpha sum_i (y_i - 1/2)^2`, `u* = -2 alpha (y - 1/2)/rho`,
    `OPT = d alpha / 12`. The flow contracts at rate `k = 2 alpha / rho`, so
    `mu* = rho/(rho - d k) (1 - (2 max_i |y_i - 1/2|)^{(rho - d k)/k})`, bounded exactly when `rho > d k`.

    ``shear`` chooses the integer matrix `A`: none, chain, or random by ``seed``. Where a ``control_limit`` is below
    `sup |u*| = sqrt(d) alpha / rho`, or one of a list below `alpha / rho`, that optimum is out of reach, and the exact
    truth is not given. Nor is it with ``noise``; but bounds of `mu*` and `u*` are: along any `e` the second derivative `v`
    of `V*` in `y` has `v + v^2 / rho^2 <= 2 / d` where it is largest, and the first one is at most that of `f`, by
    differentiating the Hamilton-Jacobi-Bellman equation. So the flow contracts at rate `k` at most along each coordinate,
    and `sup mu*` is no larger than without noise.
    """

    def __init__(
        self,
        dim: int = 2,
        shear: str = "chain",
        discount: float = 2.0,
        seed: int = 0,
        control_limit: Limit = None,
        noise: float | Sequence[float] = 0.0,
    ) -> None:
        super().__init__(dim=dim, discount=discount, control_limit=control_limit, noise=noise)
        self.shear = require_choice("problem.shear", shear, SHEARS)
        self.seed = require_integer("problem.seed", seed, 0)
        self.A = shear_matrix(self.dim, self.shear, self.seed)
        self.A_inverse = torch.linalg.inv(self.A).round()
        rho, d = self.discount, self.dim
        # As a quotient: the difference of the docstring has no digits left where rho is large.
        self._alpha = 2.0 / d / (math.sqrt(1.0 + 8.0 / (d * rho**2)) + 1.0)
        self._rate = 2.0 * self._alpha / rho
        excess = rho - d * self._rate
        self.state_cost_bound = 0.25
        self.value_bound = self.state_cost_bound if self.noisy else d * self._alpha / 4.0
        self.control_bound = reach = 1.0 / (math.sqrt(d) * rho) if self.noisy else math.sqrt(d) * self._alpha / rho
        self.occupation_bound = rho / excess if excess > CRITICAL * rho else math.inf
        self.exact_optimum = d * self._alpha / 12.0
        corner = torch.full((1, d), reach / math.sqrt(d), dtype=torch.float64)
        in_reach = bool(torch.isfinite(self.control_cost.cost(corner)))
        self._exact = in_reach and not self.noisy
        if self.noisy:
            self.exact_optimum = None
        if not in_reach:
            # Another problem: only what bounds every problem with this cost is still known.
            self.value_bound = self.occupation_bound = self.exact_optimum = None
            self.control_bound = self.control_cost.reach

    def _offset(self, x: Tensor) -> Tensor:
        """`y - 1/2` in `[-1/2, 1/2)`, ``(N, d)``."""
        return (x @ self._like(x, "A", self.A).T).remainder(1.0) - 0.5

    def state_cost(self, x: Tensor) -> Tensor:
        return self._offset(x).square().mean(dim=-1)

    def control_matrix(self, x: Tensor) -> Tensor:
        return self._like(x, "B", self.A_inverse).expand(len(x), self.dim, self.dim)

    def control_divergence(self, x: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def exact_value(self, x: Tensor) -> Tensor | None:
        return None if not self._exact else self._alpha * self._offset(x).square().sum(dim=-1)

    def exact_control(self, x: Tensor) -> Tensor | None:
        return None if not self._exact else -self._rate * self._offset(x)

    def exact_occupation(self, x: Tensor) -> Tensor | None:
        if not self._exact:
            return None
        reach = 2.0 * self._offset(x).abs().amax(dim=-1)
        excess = self.discount - self.dim * self._rate
        # log(1/reach)/k is when a start on the cube's face arrives: mu* integrates rho e^{-excess t} up to then.
        arrival = -reach.log() / self._rate
        if abs(excess) < CRITICAL * self.discount:
            return self.discount * arrival
        return -self.discount / excess * torch.expm1(-excess * arrival)
