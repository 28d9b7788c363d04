r"""One grid, solved: a semi-Lagrangian scheme for the discounted Hamilton-Jacobi-Bellman equation, by policy iteration.

Dynamic programming over a step `tau` with the control held constant, `beta = e^{-rho tau}`:

    V(x) = min_u  int_0^tau rho e^{-rho t} (f(x_t) + |u|^q / q) dt + beta V(x_tau)

The path is a midpoint step, the integral a quadrature of Simpson's kind. `V(x_tau)` is interpolated: multilinearly plus the
difference to cubic interpolation, clipped at `CLIP osc(V) h^{3/2}`. Multilinear interpolation alone makes the scheme
monotone, so that it converges to the viscosity solution; what is clipped stays `O(h^{1/2})` of it after division by
`1 - beta`, so the clipped scheme converges to the same limit. Where `V` is smooth nothing is clipped, and with `tau`
proportional to `h` the error is `O(tau^2)`.

The minimum over `u` is taken over finitely many candidates, each judged by the whole right side: the control now held, the
closed-form minimiser `u = |s|^{q'-2} s`, `s = -B^T grad V / rho` (cut to the limit on the control, if there is one: mixtures
of controls within a ball stay in it), at the midpoint of its path, and the same from the
controls of neighbouring nodes, which carries a better branch across a kink.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ocp_torch.problems.problem import Problem
from ocp_torch.studies.reference.grid import Grid
from ocp_torch.studies.reference.linear import solve_fixed_point

CLIP = 4.0
# Nodes worked on at a time: the stencils of a piece stay in the cache.
PIECE = 2**14
MOST_POLICIES = 40
# A candidate that moves the end of the path by less than this many cells is no other control; one that fails is halved.
NEGLIGIBLE, HALVINGS = 1e-3, 8
# A neighbour whose control moves that end by less would lead to the same minimum.
DIFFERENT = 0.1


@dataclass(frozen=True)
class GridSolution:
    """`V` ``(n,)`` and the controls `u` ``(n, m)`` held over a step, at the nodes of ``grid``.

    ``residual`` bounds the effect on `V` of stopping early: the largest change one more policy makes, over `1 - beta`.
    ``defect`` is that of `SemiLagrangian.defect`.
    """

    grid: Grid
    step: float
    value: Tensor
    control: Tensor
    residual: float
    defect: float
    policies: int


def running_cost(u: Tensor, q: float) -> Tensor:
    """`|u|^q / q`, ``(N,)``."""
    return u.norm(dim=-1) ** q / q


def minimiser(s: Tensor, q: float, limit: float | None = None) -> Tensor:
    """The `u` that maximises `s . u - |u|^q / q`: along `s`, of size `|s|^{q'-1}`, at most ``limit``; ``(N, m)``."""
    size = s.norm(dim=-1, keepdim=True)
    u = size ** ((2.0 - q) / (q - 1.0)) * s
    if limit is None:
        return u
    return torch.where(size ** (1.0 / (q - 1.0)) <= limit, u, limit * s / size.clamp_min(1e-300))


def discounted_weights(rho: float, tau: float) -> list[float]:
    """`int_0^tau rho e^{-rho t} l_i(t) dt`, `l_i` quadratic with nodes `0, tau/2, tau`; their sum is `1 - e^{-rho tau}`."""
    s, w = np.polynomial.legendre.leggauss(12)
    s = 0.5 * (s + 1.0)
    density = 0.5 * w * rho * tau * np.exp(-rho * tau * s)
    return [float((density * l).sum()) for l in ((1 - s) * (1 - 2 * s), 4 * s * (1 - s), s * (2 * s - 1))]


class SemiLagrangian:
    """The scheme on one grid. ``step`` is `tau`, in units of time; ``rise`` is `osc V`, to which clipping is relative. At
    0 all of the cubic correction is clipped: the scheme is monotone, and each policy lowers `V` whatever it starts from."""

    def __init__(self, problem: Problem, grid: Grid, step: float, rise: float = 0.0) -> None:
        self.problem, self.grid, self.step = problem, grid, step
        self.rho, self.q, self.limit = problem.discount, problem.exponent, problem.control_limit
        self.weights = discounted_weights(self.rho, step)
        self.gain = sum(self.weights)
        self.beta = 1.0 - self.gain
        self.x = grid.nodes()
        self.f, self.a, self.B = (
            torch.cat([function(part) for part in self.x.split(PIECE)])
            for function in (problem.state_cost, problem.drift, problem.control_matrix)
        )
        self.scale = float(self.f.max() - self.f.min())
        self.clip = CLIP * rise * grid.spacing**1.5
        self.monotone = rise == 0.0

    def speed(self, control: Tensor) -> float:
        """Root mean square over the nodes of the largest component of `a + B u`."""
        g = self.a + torch.einsum("ndm,nm->nd", self.B, control)
        return float(g.abs().amax(dim=-1).square().mean().sqrt())

    def _move(self, part: slice | Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """The midpoint and the end of the path from each node of ``part`` under ``u``."""
        x, problem = self.x[part], self.problem
        middle = x + 0.5 * self.step * (self.a[part] + torch.einsum("ndm,nm->nd", self.B[part], u))
        velocity = problem.drift(middle) + torch.einsum("ndm,nm->nd", problem.control_matrix(middle), u)
        return middle, x + self.step * velocity

    def _paid(self, part: slice | Tensor, u: Tensor, middle: Tensor, end: Tensor) -> Tensor:
        first, second, third = self.weights
        f = self.problem.state_cost
        return first * self.f[part] + second * f(middle) + third * f(end) + self.gain * running_cost(u, self.q)

    def _arrival(self, value: Tensor, end: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Stencil index, weights of the part that is linear in ``value``, and the clipped constant part."""
        stencil = self.grid.stencil(end)
        extra = stencil.cubic - stencil.linear
        difference = (extra * value[stencil.index]).sum(dim=-1)
        clipped = difference.abs() > self.clip
        weights = torch.where(clipped.unsqueeze(-1), stencil.linear, stencil.cubic)
        return stencil.index, weights, torch.where(clipped, difference.clamp(-self.clip, self.clip), 0.0)

    def _judged(self, value: Tensor, part: slice | Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The right side under ``u``; with it stencil, weights and constant, of which it is the sum."""
        middle, end = self._move(part, u)
        index, weights, constant = self._arrival(value, end)
        constant = self._paid(part, u, middle, end) + self.beta * constant
        return constant + self.beta * (weights * value[index]).sum(dim=-1), index, weights, constant

    def _closed_form(self, slope: Tensor, part: slice | Tensor, u: Tensor) -> Tensor:
        """The minimiser that `grad V` gives midway along the path under ``u``."""
        return minimiser(self._pull(slope, part, u), self.q, self.limit)

    def _pull(self, slope: Tensor, part: slice | Tensor, u: Tensor) -> Tensor:
        """`-B^T grad V / rho`, ``(N, m)``, midway along the path under ``u``; ``slope`` is `grad V` at the nodes."""
        middle, _ = self._move(part, u)
        stencil = self.grid.stencil(middle)
        gradient = (stencil.linear.unsqueeze(-1) * slope[stencil.index]).sum(dim=1)
        return -torch.einsum("ndm,nd->nm", self.problem.control_matrix(middle), gradient) / self.rho

    def improve(self, value: Tensor, control: Tensor) -> tuple[Tensor, Tensor]:
        """The best of the candidates at each node and the right side it gives."""
        grid = self.grid
        slope = grid.gradient(value)
        neighbours = [grid.shifted(control, k, cells) for k in range(grid.dim) for cells in (-1, 1)]
        controls, rights = [], []
        for first in range(0, grid.count, PIECE):
            part = slice(first, first + PIECE)
            held = control[part]
            right = self._judged(value, part, held)[0]
            u = self._closed_form(slope, part, held)
            held, right = self._towards(value, first, torch.where(torch.isfinite(u), u, held), held, right)
            for start in neighbours:
                far = self._push(part, start[part] - control[part]) > DIFFERENT * grid.spacing
                if not far.any():
                    continue
                local = far.nonzero().squeeze(1)
                u = self._closed_form(slope, local + first, start[local + first])
                u = torch.where(torch.isfinite(u), u, held[local])
                reached = self._judged(value, local + first, u)[0]
                better = reached < right[local]
                held[local[better]], right[local[better]] = u[better], reached[better]
            controls.append(held)
            rights.append(right)
        return torch.cat(controls), torch.cat(rights)

    def _push(self, part: slice, change: Tensor) -> Tensor:
        """How far a ``change`` of control moves the end of the path, ``(N,)``."""
        return self.step * torch.einsum("ndm,nm->nd", self.B[part], change).abs().amax(dim=-1)

    def _towards(self, value: Tensor, first: int, u: Tensor, held: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """``u`` where it is better than ``held``, and elsewhere the first better one halfway, a quarter of the way, ...

        Without it a control far too large for the step would be refused, and the one held taken for optimal.
        """
        held, right = held.clone(), right.clone()
        push = self._push(slice(first, first + PIECE), u - held)
        left = (push > NEGLIGIBLE * self.grid.spacing).nonzero().squeeze(1)
        share = 1.0
        for _ in range(HALVINGS):
            if len(left) == 0:
                break
            tried = held[left] + share * (u[left] - held[left])
            reached = self._judged(value, left + first, tried)[0]
            better = reached < right[left]
            held[left[better]], right[left[better]] = tried[better], reached[better]
            left, share = left[~better], 0.5 * share
        return held, right

    def defect(self, value: Tensor, control: Tensor) -> float:
        """Median over the nodes of `R(u) + R*(s) - s . u >= 0`, `s = -B^T grad V / rho` midway along the path under `u`: how
        far the Hamilton-Jacobi-Bellman equation is from being met where `V` is smooth."""
        slope, gaps = self.grid.gradient(value), []
        for first in range(0, self.grid.count, PIECE):
            part = slice(first, first + PIECE)
            s, u = self._pull(slope, part, control[part]), control[part]
            best = minimiser(s, self.q, self.limit)
            dual = (s * best).sum(dim=-1) - running_cost(best, self.q)
            gaps.append(running_cost(u, self.q) + dual - (s * u).sum(dim=-1))
        return max(float(torch.cat(gaps).median()), 0.0)

    def evaluate(self, value: Tensor, control: Tensor, tolerance: float) -> Tensor:
        """`V` of the policy ``control``, with the clipping that ``value`` has."""
        pieces = [slice(first, first + PIECE) for first in range(0, self.grid.count, PIECE)]
        judged = [self._judged(value, part, control[part])[1:] for part in pieces]
        index = torch.cat([j[0].int() for j in judged])
        matrix = self.grid.matrix(index, torch.cat([j[1] for j in judged]))
        constant = torch.cat([j[2] for j in judged])
        return solve_fixed_point(matrix, self.beta, constant, value, tolerance)

    def solve(self, value: Tensor, control: Tensor, relative: float) -> GridSolution:
        """Policy iteration from ``value`` and ``control`` until one more policy changes `V` by less than ``relative``
        of the oscillation of `f`, or no longer gets closer."""
        goal = relative * max(self.scale, 1e-300)
        residuals = []
        best = None
        for policies in range(1, MOST_POLICIES + 1):
            control, right = self.improve(value, control)
            residuals.append(float((right - value).abs().max()) / self.gain)
            if best is None or self.monotone or residuals[-1] <= best[2]:
                best = (value, control, residuals[-1], policies)
            stuck = len(residuals) > 8 and min(residuals[-4:]) > 0.7 * min(residuals[:-4])
            if residuals[-1] <= goal or (stuck and not self.monotone):
                break
            value = self.evaluate(value, control, 0.1 * self.gain * min(residuals[-1] * 0.1, goal * 10))
        value, control, residual, policies = best
        return GridSolution(self.grid, self.step, value, control, residual, self.defect(value, control), policies)
