"""Finds odd states, at which a problem's data are extreme or narrow: suprema are then sought from there too.

A network varies slowly; narrow features of a slack come from `f`, `a` or `B`, which are far cheaper to evaluate than `V` and
its gradient, so that millions of states can be scanned: a set that takes the part `3 / N` of the torus is met by `N` states
with 95 % probability. Kept are the states where a column of the data is smallest or largest, the states reached from there
downhill and uphill, and the states where a column differs most from its value nearby.
"""

import torch
from torch import Tensor

from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import climb
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced

# States scanned at once, which bounds the memory.
CHUNK = 2**16
# States kept for each column and kind of oddity: each costs an ascent of every supremum later.
KEPT = 16
# Distance, in turns, of the neighbour that a column is compared with: narrower features stand out, wider ones are met anyway.
NEARBY = 0.02
# Steps of each ascent or descent, along gradients where there are some and then in random directions.
STEPS = 60


@torch.no_grad()
def odd_states(problem: Problem, count: int, seed: int) -> Tensor:
    """States ``(K, d)`` in float64 at which the data of ``problem`` are odd, from about ``count`` random ones. Computed once
    for a problem, ``count`` and ``seed``."""
    kept = vars(problem).setdefault("_odd_states", {})
    if (count, seed) in kept:
        return kept[count, seed]
    generator = torch.Generator().manual_seed(derive_seed(seed, Branch.SCAN))
    draw = lambda size: torch.rand(size, problem.dim, generator=generator, dtype=torch.float64)
    low, high, steps = None, None, None
    for start in range(0, count // 2, CHUNK):
        x = draw(min(CHUNK, count // 2 - start))
        away = torch.nn.functional.normalize(draw(len(x)) - 0.5)
        near = (x + NEARBY * away).remainder(1.0)
        here, there = _columns(problem, x), _columns(problem, near)
        values, alone = torch.cat([here, there]), torch.cat([x, near])
        low, high = _highest(low, -values, alone), _highest(high, values, alone)
        steps = _highest(steps, (here - there).abs(), torch.cat([x, near], dim=1))
    found = [draw(0)]
    if low and high and steps:
        found += [states.reshape(-1, problem.dim) for _, states in (low, high, steps)]
        found += [_extremes(problem, low[1], -1.0), _extremes(problem, high[1], 1.0)]
    kept[count, seed] = torch.cat(found).unique(dim=0)
    return kept[count, seed]


def _extremes(problem: Problem, states: Tensor, sign: float) -> Tensor:
    """States ``(K C, d)`` reached uphill, or downhill for a ``sign`` of -1, from ``states`` ``(K, C, d)``, each in its own
    column."""
    column = torch.arange(states.shape[1]).repeat(len(states)).unsqueeze(-1)
    own = lambda x: sign * _columns(problem, x).gather(1, column).squeeze(-1)
    x = states.flatten(0, 1)
    with torch.enable_grad():
        smooth = own(x.detach().requires_grad_(True)).requires_grad
    for differentiable in (True, False)[not smooth :]:
        x, _ = climb(own, x, own(x), STEPS, differentiable=differentiable)
    return x.remainder(1.0)


def _columns(problem: Problem, x: Tensor) -> Tensor:
    """`f`, `a`, `B` and the noise as columns ``(N, C)``, without functions that are not overridden."""
    columns = [problem.state_cost(x).unsqueeze(-1)]
    if not problem.driftless:
        columns.append(problem.drift(x))
    if replaced(problem, "control_matrix", Problem):
        columns.append(problem.control_matrix(x).flatten(1))
    if replaced(problem, "noise", Problem) and (sigma := problem.noise(x)) is not None:
        columns.append(sigma.flatten(1))
    return torch.cat(columns, dim=1)


def _highest(kept: tuple[Tensor, Tensor] | None, score: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """The `KEPT` highest scores of each column so far, ``(K, C)``, and their states, ``(K, C, ..)``."""
    top, rows = score.topk(min(KEPT, len(score)), dim=0)
    states = x[rows]
    if kept is not None:
        top, states = torch.cat([kept[0], top]), torch.cat([kept[1], states])
        top, rows = top.topk(min(KEPT, len(top)), dim=0)
        states = states.gather(0, rows.unsqueeze(-1).expand(-1, -1, states.shape[-1]))
    return top, states
