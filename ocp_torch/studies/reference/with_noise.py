"""The grids of a problem with noise, and the error that moving one of them shows."""

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from ocp_torch.problems.problem import Problem
from ocp_torch.studies.reference.error import SAFETY
from ocp_torch.studies.reference.finite_differences import FiniteDifferences
from ocp_torch.studies.reference.grid import Grid
from ocp_torch.studies.reference.policy_iteration import GridSolution, solve

# Tolerance of the rough start of policy iteration.
ROUGH = 1e-3
# Tolerance by dimension: with noise policy iteration converges like Newton's method, to ten digits of the optimum. In three
# dimensions, where equations are solved by iteration, fewer suffice: the errors of those grids are larger.
TOLERANCE = {1: 1e-12, 2: 1e-12, 3: 1e-8}
# Parts of a cell by which the coarsest grid is moved, by dimension. A grid is off by `O(h)` beside a jump of the data, by the
# place of the jump in a cell, which may be the same on all grids: without moves 30 of 240 stated errors were too small.
MOVES = {1: 32, 2: 8, 3: 4}
# Kinks and smooth data, whose error is `O(h^2)`, move the number by up to so many times its error: that much is no jump.
SMOOTH = 3.0


def with_noise(problem: Problem, sides: Sequence[int]) -> tuple[list[GridSolution], bool]:
    """The solutions by finite differences on grids of ``sides`` nodes a coordinate, with densities; and whether their error
    is known to be a series in `h^2`, as it is where noise alone makes all weights positive."""
    solutions: list[GridSolution] = []
    even = True
    for n in sides:
        grid = Grid(problem.dim, n)
        scheme, found = _solved(problem, grid, *(solutions[-1].carried(grid) if solutions else (None, None)))
        even = even and not scheme.needs_viscosity(found.control)
        solutions.append(
            replace(found, occupation=scheme.occupation(found.value, found.control, TOLERANCE[problem.dim]))
        )
    return solutions, even


def moved_numbers(problem: Problem, coarse: GridSolution) -> list[float]:
    """`OPT` on the grid of ``coarse`` moved by each part of a cell."""
    grids = moved_grids(coarse.grid)
    return [_solved(problem, grid, coarse.value, coarse.control)[1].mean(problem) for grid in grids]


def moved_grids(grid: Grid) -> list[Grid]:
    """``grid`` moved by each part of a cell."""
    parts = MOVES[grid.dim]
    return [Grid(grid.dim, grid.side, k / parts) for k in range(1, parts)]


def error_of_jumps(sides: Sequence[int], coarse: float, extrapolated: float, moved: Sequence[float]) -> float:
    """The error that jumps of the data may leave in the ``extrapolated`` number of grids of ``sides``; the coarsest grid
    gives ``coarse``, and the numbers ``moved`` where it is moved."""
    spread = max(abs(number - coarse) for number in moved)
    return SAFETY * sides[0] / sides[-1] * max(spread - SMOOTH * abs(coarse - extrapolated), 0.0)


def _solved(
    problem: Problem, grid: Grid, value: Tensor | None, control: Tensor | None
) -> tuple[FiniteDifferences, GridSolution]:
    """The scheme on ``grid`` and its solution, from ``value`` and ``control`` if there are any."""
    scheme = FiniteDifferences(problem, grid)
    if value is None or control is None:
        value, control = scheme.f, scheme.f.new_zeros(grid.count, problem.control_dim)
    # The monotone scheme first, which lowers `V` from any start.
    rough = solve(scheme, value, control, ROUGH)
    scheme = FiniteDifferences(problem, grid, float(rough.value.max() - rough.value.min()))
    return scheme, solve(scheme, rough.value, rough.control, TOLERANCE[problem.dim])
