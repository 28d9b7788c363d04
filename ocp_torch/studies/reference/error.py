"""The error of the numbers of three grids: extrapolation, and a search for features between the nodes, which all grids would
miss."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import batched, supremum
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import start_distribution
from ocp_torch.studies.reference.finite_differences import diffusion
from ocp_torch.studies.reference.grid import Grid

# Order of the schemes where V is smooth, by which the leading error is removed.
ORDER = 2.0
# Order of linear interpolation.
LINEAR = 1.0
# Factor on the change of the extrapolated number from one pair of grids to the next: covers every order from 1 on.
SAFETY = 3.0
# Part of what extrapolation removes that counts as uncertain at least, times SAFETY.
DOUBT = 0.1
# Range in which the order of the grids is looked for: no scheme has one outside.
ORDERS = (1e-3, 12.0)
# Numbers that differ by less, relative to their size, are the same.
ROUNDING = 1e-10
PER_NODE = 4  # states evaluated between the nodes, for each node
FEWEST = 2**16  # of these states, at least
MOST = 2**18  # of these states, at most
NEAR_STARTS = 2**10  # more of these states, where `mu0` or `f` is narrow
# States worked on at once: their stencils of 64 nodes each fit the memory.
PIECE = 2**13
ASCENTS = 32  # from the states that stand out most
STEPS = 60  # of each ascent
# A feature between the nodes of more than this part of a function's oscillation makes the error unknown; so does as much mass
# of mu0 that the nodes miss.
UNSEEN = 0.02
# Oscillations below this part of the largest value are rounding.
FLAT = 1e-9
# The tip of a kink rises above the nodes around by less than this part of their own differences: such tips do not count.
KINK = 0.5


class Extrapolation(NamedTuple):
    """``optimum`` with its stated ``error``, and the ``order`` the three grids show (NaN where they show none: the error is
    then unknown, `None`)."""

    optimum: float
    error: float | None
    order: float


def extrapolate(
    spacings: Sequence[float],
    numbers: Sequence[float],
    noise: float = 0.0,
    even: bool = False,
    order: float = ORDER,
) -> Extrapolation:
    r"""Richardson's extrapolation of ``numbers`` on grids of ``spacings`` `h_1 > h_2 > h_3`, taken as `Q + C h^r` with the
    ``order`` `r`.

    With `X_12`, `X_23` from the two pairs of grids and `Q_3` the finest number the stated error is
    `SAFETY max(|X_23 - X_12|, DOUBT |X_23 - Q_3|)`. If the error is `C h^p` instead, that of `X_23` is below it for every
    `p` from 1 on, whatever `r` is, where the ratio of spacings is 4/3 or more.

    Where the error is known to have an expansion in `h^2` (``even``) no more is in doubt than the order seen is off: an error
    `C h^p` leaves `|p - 2| C h^2` of it.

    Numbers that show no order say nothing about what they approach, unless all agree within ``noise``, their own error.
    """
    from scipy.optimize import brentq

    (h1, h2, h3), (Q1, Q2, Q3) = spacings, numbers
    pair = lambda coarse, fine, h, k: fine + (fine - coarse) / ((h / k) ** order - 1.0)
    earlier, optimum = pair(Q1, Q2, h1, h2), pair(Q2, Q3, h2, h3)
    settled = max(numbers) - min(numbers) <= noise + ROUNDING * max(map(abs, numbers))
    # At the order p this is (h_1^p - h_2^p) / (h_2^p - h_3^p), which increases in p; none has changes of opposite signs.
    ratio = (Q1 - Q2) / (Q2 - Q3) if Q2 != Q3 else math.nan
    excess = lambda p: (h1**p - h2**p) / (h2**p - h3**p) - ratio
    shown = ratio > 0.0 and excess(ORDERS[0]) < 0.0 < excess(ORDERS[1])
    seen = brentq(excess, *ORDERS) if shown else math.nan
    doubt = min(DOUBT, abs(seen - ORDER)) if even and shown else DOUBT
    error = SAFETY * max(abs(optimum - earlier), doubt * abs(optimum - Q3))
    return Extrapolation(optimum, error if settled or shown else None, seen)


def look_between(problem: Problem, grid: Grid) -> tuple[float, float, str | None]:
    """Compare `f`, `a`, `B` and `D` between the nodes of ``grid`` with the nodes around, at many states and on ascents from
    there, and the mass of `mu0` at the nodes with 1.

    Returns the largest amount by which `f` falls below the nodes around, as `V` can be too high by as much; the distance of
    the mass from 1; and a sentence with what makes the error unknown, and where, or `None`.
    """
    seed = derive_seed(0, Branch.REFERENCE)
    x = scrambled_sobol(min(max(PER_NODE * grid.count, FEWEST), MOST), problem.dim, seed, torch.float64)
    x = torch.cat([x, start_distribution(problem).draw(NEAR_STARTS, 0, seed)[0]])
    cost = lambda x: problem.state_cost(x).unsqueeze(-1)
    matrix = lambda x: problem.control_matrix(x).flatten(1)
    found = [
        ("the state cost falls", *_unseen(grid, cost, x, -1.0)),
        ("the state cost rises", *_unseen(grid, cost, x, 1.0)),
        *(("the drift is off", *_unseen(grid, problem.drift, x, sign)) for sign in (-1.0, 1.0)),
        *(("the control matrix is off", *_unseen(grid, matrix, x, sign)) for sign in (-1.0, 1.0)),
    ]
    if problem.noisy:
        spread = lambda x: diffusion(problem, x).flatten(1)
        found += [("the noise is off", *_unseen(grid, spread, x, sign)) for sign in (-1.0, 1.0)]
    mean = float(batched(problem.initial_density, grid.nodes(), PIECE).mean())
    what, share, size, place = max(found, key=lambda f: f[1])
    sentence = None
    if share > UNSEEN:
        at = [round(c, 5) for c in place.tolist()]
        sentence = f"{what} by {size:.3g} between the nodes at x = {at}, which none of them shows"
    elif abs(mean - 1.0) > UNSEEN:
        sentence = f"the initial density has mass {mean:.4g} at the nodes, not 1"
    return found[0][2], abs(mean - 1.0), sentence


def _unseen(grid: Grid, function: Callable[[Tensor], Tensor], x: Tensor, sign: float) -> tuple[float, float, Tensor]:
    """The largest rise of ``function``, times ``sign``, above all nodes of the cubic stencil and above cubic interpolation:
    relative to its oscillation, absolutely, and its state.

    A smooth function rises above its nodes by `O(h^2)` but hardly above the interpolation; beside a jump or a kink the
    interpolation is far off but the nodes are not, nor by more than they differ themselves.
    """
    values, sampled = batched(function, grid.nodes(), PIECE), batched(function, x, PIECE)
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

    # Ascents from the highest states too: a feature may be narrower than the distance of the states.
    highest = x[(sign * sampled / size).amax(dim=-1).topk(ASCENTS).indices]
    level = lambda x: (sign * function(x) / size).amax(dim=-1)
    climbed = supremum(level, highest, ASCENTS, STEPS, differentiable=False)
    found = supremum(excess, torch.cat([x, climbed.x.unsqueeze(0)]), ASCENTS, STEPS, differentiable=False)
    scale = float(size[torch.isfinite(size)].max()) if bool(torch.isfinite(size).any()) else 0.0
    return found.value, found.value * scale, found.x
