"""The occupation density of a closed loop, found backwards in time along trajectories, and its supremum."""

import math
from typing import cast

import torch
from torch import Tensor

from ocp_torch.compute.threads import in_pieces
from ocp_torch.control.policies import Policy, ValuePolicy, is_even
from ocp_torch.maths.brownian import Grid, discounted, increments, path_integral
from ocp_torch.maths.runge_kutta import Dynamics, discounted_integral
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.sums import summed
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.problem import Problem

# Length of a piece of the integral over the past, in discount times: shorter pieces end sooner where the past counts little.
PIECE = 2.5
MOST_PIECES = 16  # what has not settled by then is extrapolated
SETTLED = 5e-3  # part of the integral that the last piece may add
# Longest step of a piece in discount times, and in turns that a state moves; but the number of steps has limits.
STEP_TIME = 0.25
STEP_LENGTH = 0.1
FEWEST_STEPS, MOST_STEPS = 10, 75
# The logarithm at which the growth of a density is cut off, so that it stays a number: e^60 is unbounded to any check.
LARGEST_GROWTH = 60.0
# Evaluations of the noisy loop at each state and time at first, shared by the paths and the `d + 1` differences on each.
FEW_EVALUATIONS = 48
EVALUATIONS = 192  # near the densest states: more show a density that is too large for M more surely
FEWEST_PATHS = 4  # from each state, with noise
DENSEST_STATES = 6  # of the first look, near which the density is computed again
NEARBY_DIVISOR = 3  # of the number of all states, for the number of states near those
ASCENTS = 16  # to the suprema of the a-priori bound, which is shown beside the density itself and decides nothing
ASCENT_STEPS = 20
# Step of a difference quotient of the velocity: truncation is then about 1e-7 of its second derivatives, rounding 1e-9.
DIFFERENCE = 1e-7


def backward_flow(problem: Problem, policy: Policy, together: bool = False) -> Dynamics:
    r"""`dy/dt = -g(y)` for the closed loop `g = a + B u`, with the logarithm of the density's growth as one more coordinate.

    Its discounted integral is `mu^u(x) = rho int e^{-rho t} mu0(y_t) exp(-int_0^t div g(y_s) ds) dt`, `y_0 = x`: the density
    of a flow changes by its divergence (the representation behind Proposition 8 of the paper). Valid for a Lipschitz loop.
    Differences of `g`, all in one call, are cheaper than derivatives of a controller that is a derivative itself, unless the
    controller knows its divergence and `B` is constant (`ValuePolicy.flux_divergence`).

    It is evaluated on all cores ``together`` if ``problem`` and ``policy`` are pure functions.

    With noise, whose divergences must be known, `dy = (2 div D - g) dt + sigma dW`, the density grows by `div div D - div
    g`, and `mu^u(x)` is the mean over paths (Feynman and Kac, for the adjoint equation).
    """

    loop, known = ClosedLoop(problem, policy), differentiable(problem, policy)

    def backward(state: Tensor) -> tuple[Tensor, Tensor]:
        y, log_factor = state[:, :-1], state[:, -1]
        if known and is_even(problem, problem.control_matrix(y)):
            exact = lambda at: cast(tuple[Tensor, Tensor], loop.vector_fields(at)[::2])
            here, divergence = in_pieces(exact, y, together)
        else:
            moves = DIFFERENCE * torch.eye(y.shape[1], dtype=y.dtype)
            around = torch.cat([y, *(y + move for move in moves)])
            (velocity,) = in_pieces(lambda at: (problem.velocity(at, policy(at)),), around, together)
            here, *moved = velocity.chunk(len(moves) + 1)
            divergence = summed((g[:, i] - here[:, i]) / DIFFERENCE for i, g in enumerate(moved))
        motion = torch.cat([-here, -divergence.unsqueeze(-1)], dim=-1)
        if problem.noisy:
            div_D, div_div_D = cast(tuple[Tensor, Tensor], problem.noise_divergences(y))
            motion = motion + torch.cat([2.0 * div_D, div_div_D.unsqueeze(-1)], dim=-1)
        return motion, problem.initial_density(y) * log_factor.clamp_max(LARGEST_GROWTH).exp()

    return backward


def differentiable(problem: Problem, policy: Policy) -> bool:
    """Whether the divergence of the closed loop is known without differences; where `B` is constant it then costs less."""
    return isinstance(policy, ValuePolicy) and problem.gives_divergences


def settled_occupation(
    problem: Problem, policy: Policy, x: Tensor, evaluations: int = EVALUATIONS, together: bool = False
) -> Tensor:
    """`mu^u` ``(N,)`` at ``x`` by the `backward_flow`, as far back as it takes; infinite where the past adds ever more. With
    noise the mean over as many paths as ``evaluations`` allow, less twice its standard error: a lower estimate, and finite.

    Where the flow contracts nearly as fast as the discount decays, the integral settles slowly and geometrically: the rest
    is extrapolated from the last pieces.
    """
    rho, dynamics = problem.discount, backward_flow(problem, policy, together)
    horizon = PIECE / rho
    with torch.no_grad():
        speed = float(problem.velocity(x, policy(x)).norm(dim=-1).max())
    wanted = math.ceil(horizon * max(rho / STEP_TIME, speed / STEP_LENGTH))
    steps = int(min(MOST_STEPS, max(FEWEST_STEPS, wanted)))
    paths = max(FEWEST_PATHS, evaluations // (problem.dim + 1)) if problem.noisy else 1
    state = torch.cat([x, x.new_zeros(len(x), 1)], dim=-1).repeat_interleave(paths, dim=0)
    pieces, settled = list[Tensor](), False  # each along each path, (N, paths)
    for k in range(MOST_PIECES):
        if problem.noisy:
            piece, state = _noisy_piece(problem, dynamics, state, horizon, steps, k)
        else:
            piece, state = discounted_integral(dynamics, state, rho, horizon, steps, wrap=False)
        pieces.append(piece.unflatten(0, (len(x), paths)))
        settled = bool((pieces[-1].mean(dim=1) <= SETTLED * summed(pieces).mean(dim=1)).all())
        if settled:
            break
        # From here on the discount of the time that has passed is part of the factor.
        state = torch.cat([state[:, :-1].remainder(1.0), state[:, -1:] - PIECE], dim=-1)
    whole = summed(pieces)
    if problem.noisy:  # the scatter of paths that grow for long shows any trend
        return (whole.mean(dim=1) - 2.0 / math.sqrt(paths) * whole.std(dim=1)).clamp_min(0.0)
    if settled:
        return whole[:, 0]
    before, last = (summed(part)[:, 0] for part in (pieces[-4:-2], pieces[-2:]))
    ratio = last / before.clamp_min(1e-300)
    rest = torch.where(ratio < 1.0, last * ratio / (1.0 - ratio), math.inf)
    return whole[:, 0] + torch.where(last > SETTLED * whole[:, 0], rest, 0.0)


def _noisy_piece(
    problem: Problem, dynamics: Dynamics, state: Tensor, horizon: float, steps: int, piece: int
) -> tuple[Tensor, Tensor]:
    """One piece of the integral along each path, and its end; noise moves all but the logarithm."""
    sigma = lambda at: torch.nn.functional.pad(cast(Tensor, problem.noise(at[:, :-1])), (0, 0, 0, 1))
    grid = Grid(torch.full_like(state[:, 0], horizon), steps, 1.0)
    moves = increments(grid, sigma(state[:1]).shape[-1], 0, 0, piece)
    return path_integral(dynamics, sigma, state, grid, moves, discounted(problem.discount))


def estimated_sup_occupation(
    problem: Problem,
    policy: Policy,
    end_states: Tensor,
    states: int,
    together: bool = False,
    rounded: Policy | None = None,
) -> float:
    """The largest `mu^u` met: at ends of trajectories, where mass gathers, at uniform states, and then near the densest of
    these; ``together`` as in `backward_flow`. ``rounded``, the policy in single precision, is used where no differences are
    taken."""
    if rounded is not None and differentiable(problem, rounded):
        policy = rounded if is_even(problem, problem.control_matrix(end_states)) else policy
    count = max(1, 2 * states // 3)
    picked = end_states[:: max(1, len(end_states) // count)][:count]
    generator = fixed_generator()
    uniform = torch.rand(states - len(picked), problem.dim, dtype=picked.dtype, generator=generator)
    x = torch.cat([picked, uniform])
    mu = lambda x, effort: settled_occupation(problem, policy, x, effort, together)
    met = lambda x, effort: mu(x, effort).nan_to_num(nan=math.inf, posinf=math.inf)
    density = met(x, FEW_EVALUATIONS)
    if not bool(torch.isfinite(density).all()):
        return math.inf
    top = x[density.topk(min(DENSEST_STATES, len(x))).indices]
    count = states // NEARBY_DIVISOR
    around = top[torch.arange(count) % len(top)]
    steps = torch.randn(around.shape, dtype=x.dtype, generator=generator) / math.sqrt(problem.dim)
    sizes = 10.0 ** (-1.0 - 2.0 * torch.rand(count, 1, dtype=x.dtype, generator=generator))
    near = torch.cat([top, (around + sizes * steps).remainder(1.0)])
    return max(float(density.max()), float(met(near, EVALUATIONS).max()))


def a_priori_sup_occupation(problem: Problem, policy: Policy, points: Tensor) -> float | None:
    r"""`sup mu^u <= rho sup mu0 / (rho - sup(div div D - div g))` where that is positive, else `None`; both suprema as met at
    ``points`` and climbed. For a Lipschitz closed loop only: contraction on a jump has no divergence to show it."""
    if not problem.gives_divergences:
        return None
    loop = ClosedLoop(problem, policy)
    largest = lambda function: supremum(function, points, ASCENTS, ASCENT_STEPS, differentiable=False).value
    spread = lambda x: cast(tuple, problem.noise_divergences(x))[1] if problem.noisy else 0.0
    contraction = lambda x: spread(x) - cast(Tensor, loop.drift_divergence(x))  # there is one: see above
    excess = problem.discount - max(0.0, largest(contraction))
    return problem.discount * largest(problem.initial_density) / excess if excess > 0.0 else None
