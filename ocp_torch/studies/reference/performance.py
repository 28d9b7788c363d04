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

# Residual that is left where the equation is solved by iteration.
TOLERANCE = 1e-12


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
    numbers, even = [], True
    for n in sides:
        scheme = FiniteDifferences(problem, Grid(problem.dim, n))
        x = scheme.grid.nodes()
        control = batched(policy, x, PIECE).to(scheme.f)
        rough = scheme.evaluate(scheme.f, control, TOLERANCE)
        scheme = FiniteDifferences(problem, scheme.grid, float(rough.max() - rough.min()))
        value = scheme.evaluate(rough, control, TOLERANCE)
        numbers.append(math.fsum((value * batched(problem.initial_density, x, PIECE)).tolist()) / scheme.grid.count)
        even = even and not scheme.needs_viscosity(control)
    return extrapolate([1.0 / n for n in sides], numbers, even=even)
