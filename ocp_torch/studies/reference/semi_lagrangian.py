r"""A semi-Lagrangian scheme for the discounted Hamilton-Jacobi-Bellman equation, on one grid.

Dynamic programming over a step `tau` with the control held constant, `beta = e^{-rho tau}` (Falcone and Ferretti,
*Semi-Lagrangian Approximation Schemes*, 2013):

    V(x) = min_u  int_0^tau rho e^{-rho t} (f(x_t) + |u|^q / q) dt + beta V(x_tau)

The path is a midpoint step, the integral a quadrature of Simpson's kind. `V(x_tau)` is interpolated: multilinearly plus the
difference to cubic interpolation, clipped at `CLIP osc(V) h^{3/2}`. Multilinear interpolation alone makes the scheme
monotone, so that it converges to the viscosity solution; what is clipped stays `O(h^{1/2})` of it after division by
`1 - beta`, so the clipped scheme converges to the same limit. Where `V` is smooth nothing is clipped, and with `tau`
proportional to `h` the error is `O(tau^2)`.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ocp_torch.maths.supremum import batched
from ocp_torch.problems.control_limit import Limit
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import driven
from ocp_torch.studies.reference.grid import PIECE, Grid

# Limit of the cubic correction, relative to osc(V) h^{3/2}: a smaller one costs accuracy where V is smooth and the grid
# coarse, a larger one overshoots more at kinks.
CLIP = 4.0
# Nodes of the Gauss-Legendre rule for the discounted weights: exact to rounding for steps of a part of 1 / rho.
QUADRATURE = 12


def running_cost(u: Tensor, q: float) -> Tensor:
    """`|u|^q / q`, ``(N,)``."""
    return u.norm(dim=-1) ** q / q


def minimiser(s: Tensor, q: float, limit: Limit = None) -> Tensor:
    """The `u` that maximises `s . u - |u|^q / q`, ``(N, m)``: along `s`, of size `|s|^{q'-1}`, at most ``limit``; or, where
    that is a list, entry by entry (`q = 2`)."""
    if isinstance(limit, Sequence):
        most = s.new_tensor(limit)
        return s.minimum(most).maximum(-most)
    size = s.norm(dim=-1, keepdim=True)
    u = size ** ((2.0 - q) / (q - 1.0)) * s
    if limit is None:
        return u
    return torch.where(size ** (1.0 / (q - 1.0)) <= limit, u, limit * s / size.clamp_min(1e-300))


def discounted_weights(rho: float, tau: float) -> list[float]:
    """`int_0^tau rho e^{-rho t} l_i(t) dt`, `l_i` quadratic with nodes `0, tau/2, tau`; their sum is `1 - e^{-rho tau}`."""
    s, w = np.polynomial.legendre.leggauss(QUADRATURE)
    s = 0.5 * (s + 1.0)
    density = 0.5 * w * rho * tau * np.exp(-rho * tau * s)
    return [float((density * l).sum()) for l in ((1 - s) * (1 - 2 * s), 4 * s * (1 - s), s * (2 * s - 1))]


class SemiLagrangian:
    """The scheme for ``problem`` on ``grid``; ``step`` is `tau`, in units of time; ``rise`` is `osc V`, to which clipping is
    relative. At 0 all of the cubic correction is clipped: the scheme is monotone, and each policy lowers `V` from any start.

    In its methods ``nodes`` are indices or a slice of nodes, ``u`` ``(N, m)`` their controls, ``value`` ``(n,)`` is `V` and
    ``slope`` ``(n, d)`` its gradient at all nodes. ``pieces`` are all nodes, piece by piece."""

    def __init__(self, problem: Problem, grid: Grid, step: float, rise: float = 0.0) -> None:
        self.problem, self.grid, self.step = problem, grid, step
        self.rho, self.q, self.limit = problem.discount, problem.exponent, problem.control_limit
        self.weights = discounted_weights(self.rho, step)
        self.gain = sum(self.weights)
        self.beta = 1.0 - self.gain
        self.x, self.pieces = grid.nodes(), torch.arange(grid.count).split(PIECE)
        functions = problem.state_cost, problem.drift, problem.control_matrix
        self.f, self.a, self.B = (batched(function, self.x, PIECE) for function in functions)
        self.scale = float(self.f.max() - self.f.min())
        self.clip = CLIP * rise * grid.spacing**1.5
        self.monotone = rise == 0.0

    def move(self, nodes: slice | Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The midpoint and the end of the path from each of ``nodes`` under ``u``."""
        x = self.x[nodes]
        middle = x + 0.5 * self.step * driven(self.a[nodes], self.B[nodes], u)
        return middle, x + self.step * self.problem.velocity(middle, u)

    def right_side(self, value: Tensor, nodes: slice | Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The right side ``(N,)`` under ``u``, which is linear in `V`; the nodes of `V` that enter it, their weights, and the
        constant rest, which includes the clipped correction."""
        middle, end = self.move(nodes, u)
        stencil, f = self.grid.stencil(end), self.problem.state_cost
        correction = ((stencil.cubic - stencil.linear) * value[stencil.index]).sum(dim=-1)
        clipped = correction.abs() > self.clip
        weights = torch.where(clipped.unsqueeze(-1), stencil.linear, stencil.cubic)
        constant = torch.where(clipped, correction.clamp(-self.clip, self.clip), 0.0)
        first, second, third = self.weights
        paid = first * self.f[nodes] + second * f(middle) + third * f(end) + self.gain * running_cost(u, self.q)
        constant = paid + self.beta * constant
        return constant + self.beta * (weights * value[stencil.index]).sum(dim=-1), stencil.index, weights, constant

    def pull(self, slope: Tensor, nodes: Tensor, u: Tensor) -> Tensor:
        """`-B^T grad V / rho`, ``(N, m)``, midway along the path under ``u``."""
        middle, _ = self.move(nodes, u)
        gradient = self.grid.interpolated(slope, middle)
        return -torch.einsum("ndm,nd->nm", self.problem.control_matrix(middle), gradient) / self.rho

    def closed_form(self, slope: Tensor, nodes: Tensor, u: Tensor, otherwise: Tensor) -> Tensor:
        """The minimiser that `grad V` gives midway along the path under ``u``; ``otherwise`` where that is not finite."""
        found = minimiser(self.pull(slope, nodes, u), self.q, self.limit)
        return torch.where(torch.isfinite(found), found, otherwise)

    def push(self, nodes: Tensor, change: Tensor) -> Tensor:
        """The distance by which a ``change`` of control moves the end of the path, ``(N,)``."""
        return self.step * torch.einsum("ndm,nm->nd", self.B[nodes], change).abs().amax(dim=-1)
