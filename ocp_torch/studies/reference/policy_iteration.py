"""Policy iteration for the semi-Lagrangian scheme: improve the control at every node, evaluate it, and again.

The minimum over `u` is taken over finitely many candidates, each judged by the whole right side of the scheme: the control
now held; the closed-form minimiser `u = |s|^{q'-2} s`, `s = -B^T grad V / rho` (cut to the limit on the control, if there is
one: mixtures of controls within a ball stay in it), at the midpoint of its path; and the same from the controls of
neighbouring nodes, which carries a better branch across a kink.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.studies.reference.grid import Grid
from ocp_torch.studies.reference.linear import solve_fixed_point
from ocp_torch.studies.reference.semi_lagrangian import PIECE, SemiLagrangian, minimiser, running_cost

# Policy iteration takes some ten policies; more than so many go in circles.
MOST_POLICIES = 40
# A candidate that moves the end of the path by less than this many cells is no other control; one that is not better is tried
# again halfway, so many times.
NEGLIGIBLE, HALVINGS = 1e-3, 8
# A neighbour whose control moves that end by less cells would lead to the same minimum.
DIFFERENT = 0.1
# From so many policies on: they no longer get better when the last few left more than this part of the least residual before.
FIRST, LAST, STUCK = 9, 4, 0.7
# Error of V that evaluating a policy may leave, relative to the residual of the policy before; never more than the goal.
EVALUATED = 0.01


@dataclass(frozen=True)
class GridSolution:
    """`V` ``(n,)`` and the controls `u` ``(n, m)`` held over a step, at the nodes of ``grid``.

    ``residual`` bounds the effect on `V` of stopping early: the largest change one more policy makes, over `1 - beta`.
    ``defect`` is what the function of that name gives.
    """

    grid: Grid
    step: float
    value: Tensor
    control: Tensor
    residual: float
    defect: float
    policies: int


def solve(scheme: SemiLagrangian, value: Tensor, control: Tensor, relative: float) -> GridSolution:
    """Policy iteration from ``value`` ``(n,)`` and ``control`` ``(n, m)`` until one more policy changes `V` by less than
    ``relative`` of the oscillation of `f`, or no longer gets closer."""
    goal = relative * max(scheme.scale, 1e-300)
    residuals: list[float] = []
    best: tuple[Tensor, Tensor, float, int] | None = None
    for policies in range(1, MOST_POLICIES + 1):
        control, right = improve(scheme, value, control)
        residuals.append(float((right - value).abs().max()) / scheme.gain)
        if best is None or scheme.monotone or residuals[-1] <= best[2]:
            best = (value, control, residuals[-1], policies)
        stuck = policies >= FIRST and min(residuals[-LAST:]) > STUCK * min(residuals[:-LAST])
        if residuals[-1] <= goal or (stuck and not scheme.monotone):
            break
        value = evaluate(scheme, value, control, scheme.gain * min(EVALUATED * residuals[-1], goal))
    assert best is not None
    value, control, residual, policies = best
    return GridSolution(scheme.grid, scheme.step, value, control, residual, defect(scheme, value, control), policies)


def improve(scheme: SemiLagrangian, value: Tensor, control: Tensor) -> tuple[Tensor, Tensor]:
    """The best of the candidates at each node and the right side it gives."""
    grid = scheme.grid
    slope = grid.gradient(value)
    neighbours = [grid.shifted(control, k, cells) for k in range(grid.dim) for cells in (-1, 1)]
    controls, rights = [], []
    for first in range(0, grid.count, PIECE):
        part = slice(first, first + PIECE)
        held = control[part]
        right = scheme.right_side(value, part, held)[0]
        u = scheme.closed_form(slope, part, held)
        held, right = _towards(scheme, value, first, torch.where(torch.isfinite(u), u, held), held, right)
        for start in neighbours:
            far = scheme.push(part, start[part] - control[part]) > DIFFERENT * grid.spacing
            if not far.any():
                continue
            local = far.nonzero().squeeze(1)
            u = scheme.closed_form(slope, local + first, start[local + first])
            u = torch.where(torch.isfinite(u), u, held[local])
            reached = scheme.right_side(value, local + first, u)[0]
            better = reached < right[local]
            held[local[better]], right[local[better]] = u[better], reached[better]
        controls.append(held)
        rights.append(right)
    return torch.cat(controls), torch.cat(rights)


def _towards(
    scheme: SemiLagrangian, value: Tensor, first: int, u: Tensor, held: Tensor, right: Tensor
) -> tuple[Tensor, Tensor]:
    """``u`` where it is better than ``held``, and elsewhere the first better one halfway, a quarter of the way, ...

    Without it a control far too large for the step would be refused, and the one held taken for optimal.
    """
    held, right = held.clone(), right.clone()
    push = scheme.push(slice(first, first + PIECE), u - held)
    left = (push > NEGLIGIBLE * scheme.grid.spacing).nonzero().squeeze(1)
    share = 1.0
    for _ in range(HALVINGS):
        if len(left) == 0:
            break
        tried = held[left] + share * (u[left] - held[left])
        reached = scheme.right_side(value, left + first, tried)[0]
        better = reached < right[left]
        held[left[better]], right[left[better]] = tried[better], reached[better]
        left, share = left[~better], 0.5 * share
    return held, right


def evaluate(scheme: SemiLagrangian, value: Tensor, control: Tensor, tolerance: float) -> Tensor:
    """`V` of the policy ``control``, with the clipping that ``value`` has."""
    pieces = [slice(first, first + PIECE) for first in range(0, scheme.grid.count, PIECE)]
    judged = [scheme.right_side(value, part, control[part])[1:] for part in pieces]
    index = torch.cat([j[0].int() for j in judged])
    matrix = scheme.grid.matrix(index, torch.cat([j[1] for j in judged]))
    constant = torch.cat([j[2] for j in judged])
    return solve_fixed_point(matrix, scheme.beta, constant, value, tolerance)


def defect(scheme: SemiLagrangian, value: Tensor, control: Tensor) -> float:
    """Median over the nodes of `R(u) + R*(s) - s . u >= 0`, `s = -B^T grad V / rho` midway along the path under `u`: how
    far the Hamilton-Jacobi-Bellman equation is from being met where `V` is smooth."""
    slope, gaps = scheme.grid.gradient(value), []
    for first in range(0, scheme.grid.count, PIECE):
        part = slice(first, first + PIECE)
        s, u = scheme.pull(slope, part, control[part]), control[part]
        best = minimiser(s, scheme.q, scheme.limit)
        dual = (s * best).sum(dim=-1) - running_cost(best, scheme.q)
        gaps.append(running_cost(u, scheme.q) + dual - (s * u).sum(dim=-1))
    return max(float(torch.cat(gaps).median()), 0.0)
