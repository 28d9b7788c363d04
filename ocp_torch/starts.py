"""Where trajectories start and bounds are evaluated: uniform states, and more of them where `mu0` or `f` is large.

Every point carries a weight, so that means estimate the same integrals whatever the points; where `mu0` is narrow hardly any
uniform state carries its mass, and none of a few.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.mixtures import Mixture, fitted_mixture
from ocp_torch.problems.problem import Problem
from ocp_torch.samplers import derive_seed

# Parts that stay uniform: of starts, for mass that the search missed; and of the states of bounds, most of whose integrands
# are large elsewhere too.
UNIFORM_STARTS, UNIFORM_STATES = 0.125, 0.5
# A state cost whose uniform states are worth that part of their number leaves them alone.
BROAD_COST = 0.05
# Candidates for each start that is to carry as much mass as all others.
CANDIDATES = 16


def start_law(problem: Problem) -> Mixture:
    """The density starts are drawn from: near `mu0`, and uniform where `mu0` is broad. Found once for a problem."""
    return _kept(problem, "_start_law", _fitted_starts)


def evaluation_law(problem: Problem) -> Mixture:
    """The density states are drawn from at which bounds are evaluated; uniform where neither `mu0` nor `f` is narrow."""
    return _kept(problem, "_evaluation_law", _fitted_states)


@torch.no_grad()
def initial_points(problem: Problem, count: int, replicate: int, seed: int, extra: int = 0) -> tuple[Tensor, Tensor]:
    """Starts ``(count, d + extra)``, the ``extra`` coordinates uniform, and weights ``(count,)``: `mean(weight g(x))`
    estimates `E[g mu0]`, and the mean weight is the mass of `mu0`. Replicates are independent randomised point sets."""
    points, weight = start_law(problem).draw(count, replicate, seed, extra)
    return points, weight * problem.initial_density(points[:, : problem.dim])


def drawn_starts(problem: Problem, count: int, seed: int) -> Tensor:
    """``count`` starts ``(count, d)`` drawn from `mu0`, which all count the same: weighted ones, drawn again by weight."""
    x, weight = initial_points(problem, CANDIDATES * count, 0, seed)
    if not float(weight.sum()) > 0.0:
        return x[:count]
    generator = torch.Generator().manual_seed(derive_seed(seed, count))
    return x[torch.multinomial(weight, count, replacement=True, generator=generator)]


def _kept(problem: Problem, name: str, fit) -> Mixture:
    kept = vars(problem)
    if name not in kept:
        kept[name] = fit(problem)
    return kept[name]


def _fitted_starts(problem: Problem) -> Mixture:
    if getattr(problem.initial_density, "__func__", None) is Problem.initial_density:
        return Mixture.uniform(problem.dim)
    return fitted_mixture(problem.initial_density, problem.dim).scaled(1.0 - UNIFORM_STARTS)


def _fitted_states(problem: Problem) -> Mixture:
    starts, costs = start_law(problem), fitted_mixture(problem.state_cost, problem.dim, broad=BROAD_COST)
    laws = [law for law in (starts, costs) if not law.is_uniform]
    part = (1.0 - UNIFORM_STATES) / max(1, len(laws))
    return Mixture.uniform(problem.dim) if not laws else Mixture.join([law.scaled(part) for law in laws])
