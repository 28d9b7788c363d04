r"""Waves of many coordinates, more than a list of candidates holds: found entry by entry, as Goldreich and Levin (1989) and
Kushilevitz and Mansour (1993) do.

Of `f = sum_k c_k e^{2 pi i k . x}` all waves whose first `j` entries are `p` have together the energy

    sum_{k: k_1..j = p} |c_k|^2 = E_z |E_u f(u, z) e^{-2 pi i p . u}|^2,

`u` the first `j` coordinates and `z` the others. It is estimated from many `u` for each of many `z`, and only what shows is
looked at with more entries.
"""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.fields.waves import MARGIN, conjugate, looks_at_all, standardised
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import batched
from ocp_torch.problems.problem import Problem

# Coordinates added at once, and the entries that each may have.
ADDED, ENTRIES = 3, (0.0, 1.0, -1.0, 2.0, -2.0)
# States with the same `z`, and how many `z`: an energy of .3 % of the whole shows. Four standard errors pass by chance once
# in 30,000 times. The strongest beginnings of waves go on, some at a time.
ALIKE, GROUPS, SURE, GO_ON, AT_ONCE = 64, 512, 4.0, 256, 64
# Nothing is sought where the known waves leave a smaller part of the variance: products of two waves of `V*`, of which `f` is
# made too, are 6 to 14 %. Else what was found is taken off, and smaller ones show: in 12 coordinates with waves of four 20 of
# 24 are found the first time, all of them the second.
WORTH, PASSES = 0.15, 3
# In more coordinates it would take longer than what it is for: 3 s in 12, 15 in 32, a minute or two in 64.
DEEPEST = 64


def may_be_coupled(problem: Problem) -> bool:
    """Whether waves of ``problem`` may have more coordinates than `prominent_waves` looks at together, and it can be asked at
    so many states."""
    cheap = problem.has_simulator and (problem.concurrent or problem.scan_factor > 0)
    return cheap and not looks_at_all(problem.dim) and problem.dim <= DEEPEST


@torch.no_grad()
def coupled_waves(function: Callable[[Tensor], Tensor], x: Tensor, known: Tensor, count: int) -> Tensor:
    """At most ``count`` wave vectors ``(W, d)`` of ``function`` ``(N, d) -> (N,)`` beside ``known`` ``(K, d)``, with entries
    of at most 2, found in what all of these leave of it; ``x`` ``(N, d)`` are independent states."""
    found, generator, y = known[:0], fixed_generator(), function(x)
    if not standardised(y) or not y.isfinite().all():  # nothing varies, or checks of the problem say what is wrong
        return found
    for k in range(PASSES):
        waves = torch.cat([known, found])
        weights = torch.linalg.lstsq(_design(x, waves), y.unsqueeze(-1)).solution
        rest = lambda at, waves=waves, weights=weights: function(at) - (_design(at, waves) @ weights).squeeze(-1)
        left = y - (_design(x, waves) @ weights).squeeze(-1)
        if k == 0 and not float(left.var()) > WORTH * float(y.var()):
            break
        shown = _significant(_extended(rest, x.shape[1], generator), x, left)
        new = [wave for wave in shown if not (wave == waves).all(dim=-1).any()]
        found = torch.cat([found, *(wave.unsqueeze(0) for wave in new)])
        if not new or len(found) >= count:
            break
    return found[:count]


def _design(x: Tensor, waves: Tensor) -> Tensor:
    """A constant, and cosine and sine of each of ``waves``, ``(N, 1 + 2 W)``."""
    angles = 2.0 * math.pi * (x @ waves.to(x).T)
    return torch.cat([torch.ones_like(x[:, :1]), angles.cos(), angles.sin()], dim=-1)


def _extended(function: Callable[[Tensor], Tensor], dim: int, generator: torch.Generator) -> Tensor:
    """Wave vectors ``(W, d)`` that seem to have energy in ``function``, of `k` and `-k` one."""
    begun = torch.zeros(1, 0)
    for start in range(0, dim, ADDED):
        end = min(start + ADDED, dim)
        x = torch.rand(GROUPS, 1, dim, generator=generator).repeat(1, ALIKE, 1)
        x[:, :, :end] = torch.rand(GROUPS, ALIKE, end, generator=generator)
        y = batched(function, x.flatten(0, 1)).view(GROUPS, ALIKE, 1)
        more = torch.tensor(list(itertools.product(ENTRIES, repeat=end - start)))
        ahead = conjugate(x[:, :, start:end] @ more.T)
        parts = [_energies((y * conjugate(x[:, :, :start] @ some.T)).mT @ ahead, y) for some in begun.split(AT_ONCE)]
        energy, error = (torch.cat(part) for part in zip(*parts, strict=True))
        shows = energy > SURE * error
        shows[(begun == 0.0).all(dim=-1)] &= torch.tensor(
            [next((e for e in wave if e), 0.0) >= 0.0 for wave in more.tolist()]
        )
        strongest = torch.where(shows, energy, 0.0).flatten().argsort(descending=True)[: min(GO_ON, int(shows.sum()))]
        begun = torch.cat([begun[strongest // len(more)], more[strongest % len(more)]], dim=-1)
        if not len(begun):
            return torch.zeros(0, dim)
    return begun[(begun != 0.0).any(dim=-1)]


def _energies(sums: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """From sums over the states of each group ``(G, P, E)`` the energies ``(P, E)``, without bias, and their standard errors:
    a square of a sum has the squares of its terms ``y`` in it, which no pair of states makes."""
    each = (sums.abs().square() - y.square().sum(dim=1, keepdim=True)) / (ALIKE * (ALIKE - 1))
    return each.mean(dim=0), each.std(dim=0) / math.sqrt(GROUPS)


def _significant(waves: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Those of ``waves`` whose coefficients of ``y`` at independent states ``x`` are beyond chance, the largest first."""
    power = (conjugate(x.float() @ waves.T).mT @ y.to(torch.complex64)).abs().square() / (len(x) * float(y.var()))
    order = power.argsort(descending=True)
    return waves[order[: int((power > math.log(max(len(waves), 1)) + MARGIN).sum())]]
