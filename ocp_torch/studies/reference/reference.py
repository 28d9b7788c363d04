"""A reference for `V*` and `OPT` in one to three dimensions, from grids alone: no network, no objective, no certificate."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import driven
from ocp_torch.studies.reference.error import LINEAR, ORDER, extrapolate, look_between
from ocp_torch.studies.reference.grid import PIECE, Grid, grid_sides, require_solvable
from ocp_torch.studies.reference.policy_iteration import GridSolution, solve
from ocp_torch.studies.reference.semi_lagrangian import CLIP, SemiLagrangian, minimiser
from ocp_torch.studies.reference.with_noise import error_of_jumps, moved_numbers, with_noise

CELLS = 1.0  # that a step moves a typical state by
LONGEST = 0.25  # step on the coarsest grid, in units of 1 / rho, at most
# Policy iteration ends where one more policy changes V by less, relative to the oscillation of f.
TOLERANCE = 1e-7
COARSE = 1e-4  # for the monotone scheme alone, whose own error is larger
ROUGH = 1e-3  # for the start of another iteration
# Iterations count as settled if the error of stopping them early is at most this part of the stated error.
SETTLED = 0.5
# The typical speed is found on a grid of at most so many nodes per coordinate, by dimension.
SPEED_SIDE = {1: 64, 2: 32, 3: 16}
# Rounds of this, each with the step of the round before, on which the optimal speed depends a little.
SPEED_ROUNDS = 3


@dataclass(frozen=True)
class Reference:
    """The results of three grids for ``problem``.

    ``optimum`` is `OPT` extrapolated, ``error`` its stated error, ``order`` the order observed (see `extrapolate`); an
    unknown error is `None`, and ``unknown`` says why; ``sides`` are nodes per coordinate and ``estimates`` the `OPT` of the
    three grids; ``value_change`` the largest change of `V` from the second grid to the finest; ``unsettled`` the part of
    ``error`` from iterations stopped early; ``value`` ``(side,) * d`` is `V` on the finest grid.
    """

    problem: Problem
    optimum: float
    error: float | None
    order: float
    sides: tuple[int, ...]
    estimates: tuple[float, ...]
    value_change: float
    unsettled: float
    solution: GridSolution
    unknown: str | None = None

    @property
    def value(self) -> Tensor:
        return self.solution.value.reshape([self.sides[-1]] * self.problem.dim)

    @property
    def control(self) -> Tensor:
        """The controls of the finest grid, each held for one step, ``(side,) * d + (m,)``."""
        return self.solution.control.reshape(*self.value.shape, -1)

    @property
    def occupation(self) -> Tensor | None:
        """The density `mu*` of the finest grid, ``(side,) * d``; `None` without noise."""
        found = self.solution.occupation
        return None if found is None else found.reshape(self.value.shape)

    def interpolate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """`V` ``(N,)`` and `u = grad R*(-B^T grad V / rho)` ``(N, m)`` at states ``(N, d)``, any reals.

        Within two cells of a kink the control is a mean of those on its sides.
        """
        problem, grid, V = self.problem, self.solution.grid, self.solution.value
        clip, slope = CLIP * float(V.max() - V.min()) * grid.spacing**1.5, grid.gradient(V)
        values, controls = [], []
        for part in x.double().split(PIECE):
            stencil = grid.stencil(part)
            correction = ((stencil.cubic - stencil.linear) * V[stencil.index]).sum(dim=-1)
            values.append((stencil.linear * V[stencil.index]).sum(dim=-1) + correction.clamp(-clip, clip))
            pull = torch.einsum("ndm,nd->nm", problem.control_matrix(part), grid.interpolated(slope, part))
            controls.append(minimiser(-pull / problem.discount, problem.exponent, problem.control_limit))
        return torch.cat(values), torch.cat(controls)


def solve_reference(problem: Problem, side: int | None = None, memory: float = 4.0) -> Reference:
    """Solve ``problem`` on three grids, the finest with ``side`` nodes per coordinate (None: 1024, 192, 40 by dimension,
    4096 in one with noise).

    ``memory`` in gigabytes is what the finest may take. Raises `InputError` for more than three dimensions, a grid that does
    not fit, functions that are not finite or not periodic, and a control cost other than `|u|^q / q`.
    """
    sides = grid_sides(problem, side, memory)
    with torch.no_grad():
        require_solvable(problem, Grid(problem.dim, sides[0]))
        if problem.noisy:
            solutions, even = with_noise(problem, sides)
            return _reference(problem, solutions, even, moved=moved_numbers(problem, solutions[0]))
        clipped = _reference(problem, _without_noise(problem, sides))
        if clipped.error is None or clipped.unsettled <= SETTLED * clipped.error:
            return clipped
        # The monotone scheme always settles; where V is smooth its error is larger.
        monotone = _reference(problem, _monotone(problem, sides), order=LINEAR)
        return min(clipped, monotone, key=lambda found: math.inf if found.error is None else found.error)


def _reference(
    problem: Problem,
    solutions: list[GridSolution],
    even: bool = False,
    order: float = ORDER,
    moved: Sequence[float] = (),
) -> Reference:
    """The reference from ``solutions`` on three grids; ``even`` and ``order`` are as in `extrapolate`, ``moved`` are the
    numbers of the coarsest grid moved by parts of a cell."""
    start, sides = solutions[-1], tuple(s.grid.side for s in solutions)
    estimates = tuple(s.mean(problem) for s in solutions)
    fall, missing, unknown = look_between(problem, start.grid)
    change = float((solutions[1].carried(start.grid)[0] - start.value).abs().max())
    noise = max(s.residual + s.defect for s in solutions)
    result = extrapolate([1.0 / n for n in sides], estimates, noise, even, order)
    error = result.error if unknown is None else None
    if error is not None:
        error = error + noise + fall + missing * float(start.value.abs().max())
        if moved:
            error += error_of_jumps(sides, estimates[0], result.optimum, moved)
    elif unknown is None:
        unknown = "the three grids do not approach evenly"
    unsettled = max(s.residual for s in solutions)
    return Reference(problem, result.optimum, error, result.order, sides, estimates, change, unsettled, start, unknown)


def _without_noise(problem: Problem, sides: Sequence[int]) -> list[GridSolution]:
    """The solutions on grids of ``sides`` nodes a coordinate."""
    start, pace = _speed(problem, sides[0])
    rise = float(start.value.max() - start.value.min())
    solutions = []
    for n in sides:
        grid = Grid(problem.dim, n)
        value, control = start.carried(grid)
        # The monotone scheme first: from a rough policy the clipped one may not settle.
        rough = solve(SemiLagrangian(problem, grid, pace * grid.spacing), value, control, ROUGH)
        scheme = SemiLagrangian(problem, grid, pace * grid.spacing, rise)
        start = solve(scheme, rough.value, rough.control, TOLERANCE)
        solutions.append(start)
    return solutions


def _monotone(problem: Problem, sides: Sequence[int]) -> list[GridSolution]:
    """The solutions of the monotone scheme on grids of ``sides`` nodes a coordinate."""
    start, pace = _speed(problem, sides[0])
    solutions = []
    for n in sides:
        grid = Grid(problem.dim, n)
        start = solve(SemiLagrangian(problem, grid, pace * grid.spacing), *start.carried(grid), COARSE)
        solutions.append(start)
    return solutions


def _speed(problem: Problem, coarsest: int) -> tuple[GridSolution, float]:
    """A rough solution, and the step per spacing: states at their typical speed then move `CELLS` cells a step."""
    grid = Grid(problem.dim, min(coarsest, SPEED_SIDE[problem.dim]))
    longest = LONGEST / problem.discount
    scheme = SemiLagrangian(problem, grid, longest)
    # Without drift the equation itself gives |u|^q / q' = R*(s) = f - V <= osc f.
    q = problem.exponent
    thrust = min((q / (q - 1.0) * scheme.scale) ** (1.0 / q), problem.control_cost.reach)
    fastest = float(scheme.a.abs().max()) + float(scheme.B.flatten(1).norm(dim=-1).max()) * thrust
    step = min(longest, CELLS * grid.spacing / max(fastest, 1e-300))
    value, control = scheme.f.clone(), scheme.f.new_zeros(grid.count, problem.control_dim)
    for _ in range(SPEED_ROUNDS):
        scheme = SemiLagrangian(problem, grid, step)
        rough = solve(scheme, value, control, ROUGH)
        value, control = rough.value, rough.control
        g = driven(scheme.a, scheme.B, control)
        # Of typical states: the root of the mean square, over the nodes, of the largest component.
        speed = max(float(g.abs().amax(dim=-1).square().mean().sqrt()), 1e-300)
        step = min(longest, CELLS * grid.spacing / speed)
    return rough, min(CELLS / speed, longest * coarsest)
