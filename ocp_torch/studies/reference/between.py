"""What lies between the nodes: features that no node shows, so that grids agree with one another about another problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import batched, supremum
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import start_distribution
from ocp_torch.studies.reference.grid import Grid

# States evaluated for each node, and at least and at most.
PER_NODE, FEWEST, MOST = 4, 2**16, 2**18
# States worked on at once: the stencils of 64 nodes of a piece fit the memory.
PIECE = 2**13
# And more of them where `mu0` or `f` is narrow.
NEAR_STARTS = 2**10
# Ascents from the states that stand out most, and steps of each.
ASCENTS, STEPS = 32, 60
# A feature that no node shows, of this part of a function's oscillation, makes the error unknown; so does as much mass of mu0
# that the nodes miss.
UNSEEN = 0.02
# Oscillations below that part of the largest value are rounding.
FLAT = 1e-9
# Beside a kink the nodes around differ, and its tip rises above them by less than this part of that: such tips do not count.
KINK = 0.5


@dataclass(frozen=True)
class Between:
    """``cost``: how far `f` falls below what the nodes around show, at most, by which `V` can be too high; ``mass``: how far
    the nodes' mass of `mu0` is from 1; ``sentence`` says what makes the error unknown, and where, or is `None`."""

    cost: float
    mass: float
    sentence: str | None = None


def look_between(problem: Problem, grid: Grid) -> Between:
    """Compare `f`, `a` and `B` with what the nodes of ``grid`` around give, at many states between and on ascents from there,
    and the mass of `mu0` at the nodes with 1."""
    seed = derive_seed(0, Branch.REFERENCE)
    x = scrambled_sobol(min(max(PER_NODE * grid.count, FEWEST), MOST), problem.dim, seed, torch.float64)
    x = torch.cat([x, start_distribution(problem).draw(NEAR_STARTS, 0, seed)[0]])
    cost = lambda x: problem.state_cost(x).unsqueeze(-1)
    found = [
        _unseen("the state cost falls", grid, cost, x, -1.0),
        _unseen("the state cost rises", grid, cost, x, 1.0),
    ]
    for name, function in (
        ("drift", problem.drift),
        ("control matrix", lambda x: problem.control_matrix(x).flatten(1)),
    ):
        found += [_unseen(f"the {name} is off", grid, function, x, sign) for sign in (-1.0, 1.0)]
    density = batched(problem.initial_density, grid.nodes(), PIECE)
    mass = abs(float(density.mean()) - 1.0)
    worst = max(found, key=lambda f: f[0])
    sentence = None
    if worst[0] > UNSEEN:
        at = [round(c, 5) for c in worst[2].tolist()]
        sentence = f"{worst[3]} by {worst[1]:.3g} between the nodes at x = {at}, which none of them shows"
    elif mass > UNSEEN:
        sentence = f"the initial density has mass {float(density.mean()):.4g} at the nodes, not 1"
    return Between(found[0][1], mass, sentence)


def _unseen(
    name: str, grid: Grid, function: Callable[[Tensor], Tensor], x: Tensor, sign: float
) -> tuple[float, float, Tensor, str]:
    """How far ``function``, times ``sign``, rises above all nodes of the cubic stencil and above cubic interpolation:
    relative to its oscillation, and absolutely; the state, and ``name``.

    A smooth function rises above its nodes by `O(h^2)` but hardly above the interpolation; beside a jump or a kink the
    interpolation is far off but the nodes are not, nor by more than they differ themselves.
    """
    values = torch.cat([function(part) for part in grid.nodes().split(PIECE)])
    sampled = torch.cat([function(part) for part in x.split(PIECE)])
    everything = torch.cat([values, sampled])
    size = everything.amax(dim=0) - everything.amin(dim=0)
    size = torch.where(size > FLAT * everything.abs().max(), size, torch.inf)

    def excess(x: Tensor) -> Tensor:
        here, stencil = function(x), grid.stencil(x)
        around = values[stencil.index]  # (N, 4^d, k)
        highest, lowest = (sign * around).amax(dim=1), (sign * around).amin(dim=1)
        above = sign * here - highest - KINK * (highest - lowest)
        beside = sign * (here - (stencil.cubic.unsqueeze(-1) * around).sum(dim=1))
        return (torch.minimum(above, beside).clamp_min(0.0) / size).amax(dim=-1)

    # From where the function itself is highest too: a feature may be narrower than the states are apart.
    level = (sign * sampled / size).amax(dim=-1)
    climbed = supremum(
        lambda x: (sign * function(x) / size).amax(dim=-1),
        x[level.topk(ASCENTS).indices],
        ASCENTS,
        STEPS,
        differentiable=False,
    )
    found = supremum(excess, torch.cat([x, climbed.x.unsqueeze(0)]), ASCENTS, STEPS, differentiable=False)
    scale = float(size[torch.isfinite(size)].max()) if bool(torch.isfinite(size).any()) else 0.0
    return found.value, found.value * scale, found.x, name
