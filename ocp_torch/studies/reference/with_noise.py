"""The grids of a problem with noise, and what moving one of them shows."""

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from ocp_torch.problems.problem import Problem
from ocp_torch.studies.reference.error import SAFETY
from ocp_torch.studies.reference.finite_differences import FiniteDifferences
from ocp_torch.studies.reference.grid import Grid
from ocp_torch.studies.reference.policy_iteration import GridSolution, solve

# Policy iteration with noise converges like Newton's method: ten digits of the optimum, after a rough start.
ROUGH, TOLERANCE = 1e-3, 1e-12
# Beside a jump of the data a grid is off by `O(h)`, by where in a cell the jump lies: that may be the same place on all
# grids, which then agree on another problem. So the coarsest is moved by so many parts of a cell, by dimension. Numbers that
# move by so many times their error are those of kinks and smooth data, whose error is `O(h^2)`. Measured: 240 circles of 32
# and 128 nodes with two jumps; 30 of the errors stated without were too small, by up to 400 times, and 4 with 8 parts.
MOVES, SMOOTH = {1: 32, 2: 8, 3: 8}, 3.0


def with_noise(problem: Problem, sides: Sequence[int]) -> tuple[list[GridSolution], bool]:
    """The solutions by finite differences on grids of ``sides`` nodes a coordinate, with densities; and whether their error
    is known to be a series in `h^2`, as it is where noise alone makes all weights positive."""
    solutions: list[GridSolution] = []
    even = True
    for n in sides:
        grid = Grid(problem.dim, n)
        scheme, found = _solved(problem, grid, *(solutions[-1].carried(grid) if solutions else (None, None)))
        even = even and not scheme.needs_viscosity(found.control)
        solutions.append(replace(found, occupation=scheme.occupation(found.value, found.control, TOLERANCE)))
    return solutions, even


def moved_numbers(problem: Problem, coarse: GridSolution) -> list[float]:
    """`OPT` of the grid of ``coarse``, moved by parts of a cell."""
    grids = moved_grids(coarse.grid)
    return [_solved(problem, grid, coarse.value, coarse.control)[1].mean(problem) for grid in grids]


def moved_grids(grid: Grid) -> list[Grid]:
    """``grid``, moved by parts of a cell."""
    parts = MOVES[grid.dim]
    return [Grid(grid.dim, grid.side, k / parts) for k in range(1, parts)]


def error_of_jumps(sides: Sequence[int], coarse: float, extrapolated: float, moved: Sequence[float]) -> float:
    """What jumps of the data may leave in the ``extrapolated`` number of grids of ``sides``: the coarsest gives ``coarse``,
    and ``moved`` where it is moved."""
    spread = max(abs(number - coarse) for number in moved)
    return SAFETY * sides[0] / sides[-1] * max(spread - SMOOTH * abs(coarse - extrapolated), 0.0)


def _solved(
    problem: Problem, grid: Grid, value: Tensor | None, control: Tensor | None
) -> tuple[FiniteDifferences, GridSolution]:
    """The scheme on ``grid`` and its solution, from ``value`` and ``control`` if there are any."""
    scheme = FiniteDifferences(problem, grid)
    if value is None or control is None:
        value, control = scheme.f, scheme.f.new_zeros(grid.count, problem.control_dim)
    # The monotone scheme first, which lowers `V` from anywhere.
    rough = solve(scheme, value, control, ROUGH)
    scheme = FiniteDifferences(problem, grid, float(rough.value.max() - rough.value.min()))
    return scheme, solve(scheme, rough.value, rough.control, TOLERANCE)
