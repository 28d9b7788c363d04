r"""Waves of many coordinates, more than a list of candidates holds: found entry by entry, as Goldreich and Levin (1989) and
Kushilevitz and Mansour (1993) do.

Of `f = sum_k c_k e^{2 pi i k . x}` all waves whose first `j` entries are `p` have together the energy

    sum_{k: k_1..j = p} |c_k|^2 = E_z |E_u f(u, z) e^{-2 pi i p . u}|^2,

with `u` the first `j` coordinates and `z` the others. This energy is estimated from many `u` for each of many `z`, and only
beginnings `p` of significant energy are extended by further entries.
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

COORDINATES_ADDED = 3  # by which beginnings of wave vectors are extended at once
ENTRIES = (0.0, 1.0, -1.0, 2.0, -2.0)  # of a wave vector in each coordinate
# With these numbers of states an energy of .3 % of the whole is significant.
STATES_PER_GROUP = 64  # states `u` for each `z`
GROUPS = 512  # values of `z`
STANDARD_ERRORS = 4.0  # above which an energy is significant: passed by chance once in 30,000 times
BEAM = 256  # beginnings at most that are extended, the strongest
AT_ONCE = 64  # beginnings whose energies are computed together
# No search where the known waves leave less of the variance: the part of products of two waves of `V*` in `f` is 6 to 14 %.
LEAST_VARIANCE_LEFT = 0.15
# Searches at most, each in what earlier finds leave: in 12 coordinates the first finds 20 of 24 waves, the second the others.
SEARCHES = 3
# In more coordinates a search takes longer than it is worth: 3 s in 12, a minute or two in 64.
MOST_COORDINATES = 64


def may_be_coupled(problem: Problem) -> bool:
    """Whether ``problem`` may have waves that `prominent_waves` does not look at, and a search for them is affordable."""
    cheap = problem.has_simulator and (problem.concurrent or problem.scan_factor > 0)
    return cheap and not looks_at_all(problem.dim) and problem.dim <= MOST_COORDINATES


@torch.no_grad()
def coupled_waves(function: Callable[[Tensor], Tensor], x: Tensor, known: Tensor, count: int) -> Tensor:
    """At most ``count`` wave vectors ``(W, d)`` of ``function`` ``(N, d) -> (N,)`` with entries of at most 2 in size, found
    in what the ``known`` ones ``(K, d)`` leave of it; ``x`` ``(N, d)`` are independent states."""
    found, generator, y = known[:0], fixed_generator(), function(x)
    if not standardised(y) or not y.isfinite().all():  # nothing varies, or checks of the problem say what is wrong
        return found
    for k in range(SEARCHES):
        waves = torch.cat([known, found])
        weights = torch.linalg.lstsq(_design(x, waves), y.unsqueeze(-1)).solution
        rest = lambda at, waves=waves, weights=weights: function(at) - (_design(at, waves) @ weights).squeeze(-1)
        left = y - (_design(x, waves) @ weights).squeeze(-1)
        if k == 0 and not float(left.var()) > LEAST_VARIANCE_LEFT * float(y.var()):
            break
        shown = _significant(_extended(rest, x.shape[1], generator), x, left)
        new = [wave for wave in shown if not (wave == waves).all(dim=-1).any()]
        found = torch.cat([found, *(wave.unsqueeze(0) for wave in new)])
        if not new or len(found) >= count:
            break
    return found[:count]


def _design(x: Tensor, waves: Tensor) -> Tensor:
    """The columns of a least-squares fit: a constant, the cosines of ``waves``, and their sines, ``(N, 1 + 2 W)``."""
    angles = 2.0 * math.pi * (x @ waves.to(x).T)
    return torch.cat([torch.ones_like(x[:, :1]), angles.cos(), angles.sin()], dim=-1)


def _extended(function: Callable[[Tensor], Tensor], dim: int, generator: torch.Generator) -> Tensor:
    """Wave vectors ``(W, d)`` whose energy in ``function`` is significant, one of each pair `k, -k`."""
    begun = torch.zeros(1, 0)
    for start in range(0, dim, COORDINATES_ADDED):
        end = min(start + COORDINATES_ADDED, dim)
        x = torch.rand(GROUPS, 1, dim, generator=generator).repeat(1, STATES_PER_GROUP, 1)
        x[:, :, :end] = torch.rand(GROUPS, STATES_PER_GROUP, end, generator=generator)
        y = batched(function, x.flatten(0, 1)).view(GROUPS, STATES_PER_GROUP, 1)
        more = torch.tensor(list(itertools.product(ENTRIES, repeat=end - start)))
        ahead = conjugate(x[:, :, start:end] @ more.T)
        parts = [_energies((y * conjugate(x[:, :, :start] @ some.T)).mT @ ahead, y) for some in begun.split(AT_ONCE)]
        energy, error = (torch.cat(part) for part in zip(*parts, strict=True))
        shows = energy > STANDARD_ERRORS * error
        shows[(begun == 0.0).all(dim=-1)] &= torch.tensor(
            [next((e for e in wave if e), 0.0) >= 0.0 for wave in more.tolist()]
        )
        strongest = torch.where(shows, energy, 0.0).flatten().argsort(descending=True)[: min(BEAM, int(shows.sum()))]
        begun = torch.cat([begun[strongest // len(more)], more[strongest % len(more)]], dim=-1)
        if not len(begun):
            return torch.zeros(0, dim)
    return begun[(begun != 0.0).any(dim=-1)]


def _energies(sums: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Unbiased energies ``(P, E)`` and their standard errors, from sums ``(G, P, E)`` over the states of each group: from the
    squares of these the squares of their terms ``y`` are taken off, which no pair of states makes."""
    each = (sums.abs().square() - y.square().sum(dim=1, keepdim=True)) / (STATES_PER_GROUP * (STATES_PER_GROUP - 1))
    return each.mean(dim=0), each.std(dim=0) / math.sqrt(GROUPS)


def _significant(waves: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """The ``waves`` whose coefficients in ``y`` at independent states ``x`` are beyond chance, the largest first."""
    power = (conjugate(x.float() @ waves.T).mT @ y.to(torch.complex64)).abs().square() / (len(x) * float(y.var()))
    order = power.argsort(descending=True)
    return waves[order[: int((power > math.log(max(len(waves), 1)) + MARGIN).sum())]]
