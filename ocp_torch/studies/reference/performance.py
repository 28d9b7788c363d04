"""`Perf` of a controller of a problem with noise, from grids: a linear equation, without paths or their scatter."""

import math

import torch

from ocp_torch.control.policies import Policy
from ocp_torch.errors import InputError
from ocp_torch.maths.supremum import batched
from ocp_torch.problems.problem import Problem
from ocp_torch.studies.reference.error import Extrapolation, extrapolate
from ocp_torch.studies.reference.finite_differences import FiniteDifferences
from ocp_torch.studies.reference.grid import PIECE, Grid, grid_sides, require_solvable
from ocp_torch.studies.reference.with_noise import TOLERANCE, error_of_jumps, moved_grids


@torch.no_grad()
def grid_performance(problem: Problem, policy: Policy, side: int | None = None, memory: float = 4.0) -> Extrapolation:
    """`Perf` of ``policy``, ``(N, d) -> (N, m)``, from three grids as `solve_reference` takes them, extrapolated.

    Raises `InputError` where there is no noise: without it jumps of a controller make the equation's solution another one.
    """
    if not problem.noisy:
        raise InputError(
            "problem.noise is 0, but a grid gives the performance of a controller with noise only; simulate it."
        )
    sides = grid_sides(problem, side, memory)
    require_solvable(problem, Grid(problem.dim, sides[0]))
    found = [_evaluated(problem, policy, Grid(problem.dim, n)) for n in sides]
    numbers = [number for number, _ in found]
    result = extrapolate([1.0 / n for n in sides], numbers, even=all(even for _, even in found))
    if result.error is None:
        return result
    moved = [_evaluated(problem, policy, grid)[0] for grid in moved_grids(Grid(problem.dim, sides[0]))]
    return result._replace(error=result.error + error_of_jumps(sides, numbers[0], result.optimum, moved))


def _evaluated(problem: Problem, policy: Policy, grid: Grid) -> tuple[float, bool]:
    """`Perf` on one grid, and whether noise alone makes its weights positive."""
    scheme, x = FiniteDifferences(problem, grid), grid.nodes()
    control = batched(policy, x, PIECE).to(scheme.f)
    rough = scheme.evaluate(scheme.f, control, TOLERANCE)
    scheme = FiniteDifferences(problem, grid, float(rough.max() - rough.min()))
    value = scheme.evaluate(rough, control, TOLERANCE)
    mean = math.fsum((value * batched(problem.initial_density, x, PIECE)).tolist()) / grid.count
    return mean, not scheme.needs_viscosity(control)
