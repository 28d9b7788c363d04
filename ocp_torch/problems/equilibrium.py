r"""The state of rest that a problem is controlled towards, and `V` near it, from linear-quadratic theory."""

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.simulator.simulator import Simulator
from ocp_torch.problems.systems.rest import occupation_bound_at_rest, riccati

STATES = 2**13  # at which the least cost is sought
ASCENTS = 16  # from the best of these
NEWTON_STEPS = 8  # after the ascents
# Step of finite differences, in turns: second differences then lose half the digits.
DIFFERENCE = 1e-4
# Second differences take four states for each pair of coordinates: with more coordinates no state of rest is sought.
MOST_COORDINATES = 64
# A drift slower than this part of its median over the torus counts as 0.
STILL = 1e-3
# Directions in which the cost bends less than this part of the most count as flat.
FLAT = 1e-8


class Equilibrium(NamedTuple):
    """The state ``at`` ``(d,)`` and the semidefinite Hessian ``bend`` ``(d, d)`` of `V` there, both float64; and whether
    without noise the density `mu*` is unbounded there: mass ``gathers`` (`occupation_bound_at_rest`)."""

    at: Tensor
    bend: Tensor
    gathers: bool


def equilibrium(problem: Problem) -> Equilibrium | None:
    r"""Where the state cost of ``problem`` is least, if nothing moves there without control; else `None`, as for a simulator,
    whose evaluations may be dear, and beyond 64 coordinates. Computed once for a problem, from evaluations alone.

    `V` is about `V(at) + y'Hy / 2`, `y = x - at`, with `H = rho P` and `P` of the Riccati equation of the linear dynamics and
    the quadratic cost at that state; limits of the control aside, and for `q < 2` only of that shape.
    """
    if problem not in _found:
        known = problem.has_simulator and not isinstance(problem, Simulator) and problem.dim <= MOST_COORDINATES
        _found[problem] = None
        if known:
            # No solution where no linear controller brings the state to rest, or the cost bends by no finite amount.
            with suppress(ValueError, np.linalg.LinAlgError, torch.linalg.LinAlgError):
                _found[problem] = _sought(problem)
    return _found[problem]


@torch.no_grad()
def _sought(problem: Problem) -> Equilibrium | None:
    points = torch.rand(STATES, problem.dim, dtype=torch.float64, generator=fixed_generator())
    f, speed = problem.state_cost(points), problem.drift(points).norm(dim=-1)
    least, units = float(f.min()), (float(f.std()) or 1.0, float(speed.median()) or 1.0)
    # The drift counts too: the cost may be as low at states in motion.
    merit = lambda x: (problem.state_cost(x) - least) / units[0] + (problem.drift(x) / units[1]).square().sum(dim=-1)
    at = supremum(lambda x: -merit(x), points, ASCENTS, differentiable=False).x
    for _ in range(NEWTON_STEPS):
        at = at - torch.linalg.pinv(_bend(merit, at), rtol=FLAT, hermitian=True) @ _slope(merit, at)
    x = at.unsqueeze(0)
    if not float(problem.state_cost(x)) <= least or not float(problem.drift(x).norm()) <= STILL * units[1]:
        return None
    A, Q, B = _slope(problem.drift, at).T, _bend(problem.state_cost, at), problem.control_matrix(x)[0]
    P = riccati(A, B, Q, problem.discount)
    gathers = occupation_bound_at_rest(A, B, Q, problem.discount, problem.exponent) is not None
    return Equilibrium(at.remainder(1.0), problem.discount * P, gathers)


def _slope(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """The derivatives ``(d, ...)`` of ``function`` ``(N, d) -> (N, ...)`` at one state ``(d,)``."""
    steps = DIFFERENCE * torch.eye(len(at), dtype=at.dtype)
    return (function(at + steps) - function(at - steps)) / (2.0 * DIFFERENCE)


def _bend(function: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """The Hessian ``(d, d)`` of ``function`` ``(N, d) -> (N,)`` at one state ``(d,)``."""
    steps = DIFFERENCE * torch.eye(len(at), dtype=at.dtype)
    pairs = lambda sign: function((at + steps.unsqueeze(0) + sign * steps.unsqueeze(1)).flatten(0, 1))
    mirrored = lambda sign: function((at - steps.unsqueeze(0) - sign * steps.unsqueeze(1)).flatten(0, 1))
    total = pairs(1.0) - pairs(-1.0) - mirrored(-1.0) + mirrored(1.0)
    return (total / (4.0 * DIFFERENCE**2)).unflatten(0, (len(at), len(at)))


_found: WeakKeyDictionary[Problem, Equilibrium | None] = WeakKeyDictionary()
