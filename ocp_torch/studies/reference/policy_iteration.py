"""Policy iteration: improve the control at every node, evaluate it, and again.

For the semi-Lagrangian scheme the minimum over `u` is taken over finitely many candidates, each judged by the whole right
side of the scheme: the control now held; the closed-form minimiser `u = |s|^{q'-2} s`, `s = -B^T grad V / rho` (cut to the
limit on the control, if there is one: it is convex, so mixtures of controls within stay there), at the midpoint of its path;
and the same from the controls of neighbouring nodes, which carries a better branch across a kink.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ocp_torch.maths.supremum import batched
from ocp_torch.problems.problem import Problem
from ocp_torch.studies.reference.finite_differences import FiniteDifferences
from ocp_torch.studies.reference.grid import PIECE, Grid
from ocp_torch.studies.reference.semi_lagrangian import SemiLagrangian, minimiser, running_cost

# Policy iteration takes some ten policies; more than this go in circles.
MOST_POLICIES = 40
# A candidate that moves the end of the path by fewer cells than this counts as the control now held.
NEGLIGIBLE = 1e-3
# Times that a candidate which is not better is tried again halfway.
HALVINGS = 8
# A neighbour whose control moves that end by fewer cells than this would lead to the same minimum.
DIFFERENT = 0.1
# Policies no longer get better if the residuals of the last four are all above this part of the least one before.
STUCK = 0.7
LAST = 4
FIRST = 9  # policies before that is tested
# Error of V that the evaluation of a policy may leave, relative to the last residual; never more than the goal.
EVALUATED = 0.01
# Unknowns up to which the matrix is factored: with 14,000 unknowns in three dimensions that took 14 s, and iteration 0.05 s.
DIRECT = 1200
# Iterations of the Krylov method, at most; then sweeps follow, which cannot fail where `beta W` contracts.
KRYLOV_ITERATIONS = 150
# Sweeps, at most, as a multiple of those that a contraction by beta should need.
PATIENCE = 1.5


@dataclass(frozen=True)
class GridSolution:
    """`V` ``(n,)`` and the controls `u` ``(n, m)`` held over a step, at the nodes of ``grid``. ``residual`` bounds the effect
    on `V` of stopping early: the largest change one more policy makes, over `1 - beta`. ``defect`` is what `defect` gives.
    ``occupation`` ``(n,)`` is the density of the discounted time the policy spends, with noise."""

    grid: Grid
    value: Tensor
    control: Tensor
    residual: float
    defect: float
    occupation: Tensor | None = None

    def carried(self, grid: Grid) -> tuple[Tensor, Tensor]:
        """Value and control at the nodes of another grid, the control from the nearest node."""
        values, controls = [], []
        for part in grid.nodes().split(PIECE):
            stencil = self.grid.stencil(part)
            values.append((stencil.cubic * self.value[stencil.index]).sum(dim=-1))
            nearest = stencil.index.gather(1, stencil.linear.argmax(dim=1, keepdim=True)).squeeze(1)
            controls.append(self.control[nearest])
        return torch.cat(values), torch.cat(controls)

    def mean(self, problem: Problem) -> float:
        """`int V dmu0` by the rule of equal weights, which on a torus is the trapezoidal one."""
        density = batched(problem.initial_density, self.grid.nodes(), PIECE)
        return math.fsum((self.value * density).tolist()) / self.grid.count


def solve(scheme: SemiLagrangian | FiniteDifferences, value: Tensor, control: Tensor, relative: float) -> GridSolution:
    """Policy iteration from ``value`` ``(n,)`` and ``control`` ``(n, m)`` until one more policy changes `V` by less than
    ``relative`` of the oscillation of `f`, or no longer gets closer."""
    better: Callable[..., tuple[Tensor, Tensor]]
    follow: Callable[..., Tensor]
    if isinstance(scheme, FiniteDifferences):
        better, follow = scheme.improve, scheme.evaluate
    else:
        better, follow = partial(improve, scheme), partial(evaluate, scheme)
    goal = relative * max(scheme.scale, 1e-300)
    residuals: list[float] = []
    best: tuple[Tensor, Tensor, float] | None = None
    for policies in range(1, MOST_POLICIES + 1):
        control, right = better(value, control)
        residuals.append(float((right - value).abs().max()) / scheme.gain)
        if best is None or scheme.monotone or residuals[-1] <= best[2]:
            best = (value, control, residuals[-1])
        stuck = policies >= FIRST and min(residuals[-LAST:]) > STUCK * min(residuals[:-LAST])
        if residuals[-1] <= goal or (stuck and not scheme.monotone):
            break
        value = follow(value, control, scheme.gain * min(EVALUATED * residuals[-1], goal))
    assert best is not None
    return GridSolution(scheme.grid, *best, defect(scheme, *best[:2]))


def improve(scheme: SemiLagrangian, value: Tensor, control: Tensor) -> tuple[Tensor, Tensor]:
    """The best of the candidates at each node and the right side it gives."""
    grid, slope = scheme.grid, scheme.grid.gradient(value)
    neighbours = [grid.shifted(control, k, cells) for k in range(grid.dim) for cells in (-1, 1)]
    control, right = control.clone(), torch.empty_like(value)

    def adopt(nodes: Tensor, u: Tensor) -> Tensor:
        """Hold ``u`` at those of ``nodes`` where it is better than the control held; a mask of the others."""
        reached = scheme.right_side(value, nodes, u)[0]
        better = reached < right[nodes]
        control[nodes[better]], right[nodes[better]] = u[better], reached[better]
        return ~better

    for nodes in scheme.pieces:
        held = control[nodes]
        right[nodes] = scheme.right_side(value, nodes, held)[0]
        # The closed form, or the first better control halfway to it, a quarter of the way, ...: otherwise a control far too
        # large for the step would be refused, and the one held taken for optimal.
        change = scheme.closed_form(slope, nodes, held, held) - held
        left = (scheme.push(nodes, change) > NEGLIGIBLE * grid.spacing).nonzero().squeeze(1)
        for k in range(HALVINGS):
            if len(left) == 0:
                break
            left = left[adopt(nodes[left], held[left] + 0.5**k * change[left])]
        for start in neighbours:
            far = nodes[scheme.push(nodes, start[nodes] - held) > DIFFERENT * grid.spacing]
            if len(far) > 0:
                adopt(far, scheme.closed_form(slope, far, start[far], control[far]))
    return control, right


def evaluate(scheme: SemiLagrangian, value: Tensor, control: Tensor, tolerance: float) -> Tensor:
    """`V` of the policy ``control``, with the clipping that ``value`` has."""
    pieces = []
    for nodes in scheme.pieces:
        _, index, weights, constant = scheme.right_side(value, nodes, control[nodes])
        pieces.append((index.int(), weights, constant))
    index, weights, constant = (torch.cat(parts) for parts in zip(*pieces, strict=True))
    return solve_fixed_point(index, weights, scheme.beta, constant, value, tolerance)


def solve_fixed_point(
    index: Tensor, weights: Tensor, beta: float, c: Tensor, start: Tensor, tolerance: float
) -> Tensor:
    """`V` ``(n,)`` with `|V - beta W V - c| <= tolerance` at every node, or the closest found from ``start`` on.

    Row `i` of the matrix `W` takes ``weights[i]`` at ``index[i]``, both ``(n, k)``; ``c`` and ``start`` are ``(n,)``. Direct
    if small, else by the stabilised bi-conjugate gradient method (van der Vorst, 1992), or where that breaks down by sweeps.
    """
    from scipy.sparse import csr_array, identity
    from scipy.sparse.linalg import bicgstab, spsolve

    rows = np.arange(0, index.numel() + 1, index.shape[1], dtype=np.int32)
    entries = weights.flatten().numpy(), index.flatten().int().numpy(), rows
    W = csr_array(entries, shape=(len(c), len(c)), copy=True)
    W.eliminate_zeros()  # in place; three in four entries of the monotone scheme are 0
    A, right, first = (identity(len(c)) - beta * W).tocsc(), c.numpy(), start.numpy()
    if len(right) <= DIRECT:
        return torch.from_numpy(spsolve(A, right))
    residual = lambda v: float(np.abs(right - A @ v).max())
    found, _ = bicgstab(A.tocsr(), right, x0=first, rtol=0.0, atol=tolerance, maxiter=KRYLOV_ITERATIONS)
    best = min(first, found, key=lambda v: residual(v) if np.isfinite(v).all() else math.inf)
    v, size = best, residual(best)
    sweeps = math.ceil(PATIENCE * max(math.log(max(size, tolerance) / tolerance), 0.0) / -math.log(beta))
    for _ in range(sweeps):
        following = beta * (W @ v) + right
        change = float(np.abs(following - v).max())
        if change < size:
            best, size = v, change
        if change <= tolerance or not math.isfinite(change):
            break
        v = following
    return torch.from_numpy(best)


def defect(scheme: SemiLagrangian | FiniteDifferences, value: Tensor, control: Tensor) -> float:
    """The median over the nodes of `R(u) + R*(s) - s . u >= 0`, `s = -B^T grad V / rho` midway along the path under `u`: the
    error in the Hamilton-Jacobi-Bellman equation where `V` is smooth."""
    slope, gaps = scheme.grid.gradient(value), []
    for nodes in scheme.pieces:
        u = control[nodes]
        s = scheme.pull(slope, nodes, u)
        best = minimiser(s, scheme.q, scheme.limit)
        dual = (s * best).sum(dim=-1) - running_cost(best, scheme.q)
        gaps.append(running_cost(u, scheme.q) + dual - (s * u).sum(dim=-1))
    return max(float(torch.cat(gaps).median()), 0.0)
