"""Starts of trajectories and states at which bounds are evaluated: uniform, and denser where `mu0` or `f` is large.

Every point carries a weight, so that weighted means estimate the same integrals whatever the density. Where `mu0` is narrow,
a few uniform states would all miss its mass.
"""

from functools import partial

import torch
from torch import Tensor

from ocp_torch.maths.mixture_fit import SCANNED, fitted_mixture
from ocp_torch.maths.mixtures import Mixture
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.simulator.simulator import Simulator

# Part of the starts that stays uniform, for mass of `mu0` that the fit missed.
UNIFORM_STARTS = 0.125
# Part of the states for bounds that stays uniform, since most integrands are large elsewhere too.
UNIFORM_STATES = 0.5
# Part of the starts that is near spikes of `f`, which other starts meet only by chance.
SPIKE_STARTS = 0.125
# `f` counts as broad, and adds no starts, where uniform states estimate its mean as well as this part of their number of
# ideal ones would.
BROAD_COST = 0.05
# Weighted starts drawn for each that is kept: more follow `mu0` more closely.
CANDIDATES = 16
# States at which a simulator is scanned, where each may cost milliseconds; other problems are scanned at `SCANNED`.
SIMULATOR_SCANNED = 2**12


def start_distribution(problem: Problem) -> Mixture:
    """The density that starts are drawn from: dense near `mu0` and spikes of `f`, uniform where both are broad."""
    density, cost = fits(problem)
    if density.is_uniform:
        return cost.scaled(SPIKE_STARTS)
    spikes = [] if cost.is_uniform else [cost.scaled(SPIKE_STARTS)]
    return Mixture.join([density.scaled(1.0 - UNIFORM_STARTS - SPIKE_STARTS * len(spikes)), *spikes])


def evaluation_distribution(problem: Problem) -> Mixture:
    """The density of the states at which bounds are evaluated; uniform where neither `mu0` nor `f` is narrow."""
    narrow = [d for d in fits(problem) if not d.is_uniform]
    parts = [d.scaled((1.0 - UNIFORM_STATES) / len(narrow)) for d in narrow]
    return Mixture.join([Mixture.uniform(problem.dim), *parts])


def starts_narrowly(problem: Problem) -> bool:
    """Whether hardly any uniform state carries mass of `mu0`."""
    return not fits(problem)[0].is_uniform


@torch.no_grad()
def initial_points(problem: Problem, count: int, replicate: int, seed: int, extra: int = 0) -> tuple[Tensor, Tensor]:
    """Starts ``(count, d + extra)``, the ``extra`` coordinates uniform, and weights ``(count,)``: `mean(weight g(x))`
    estimates `E[g mu0]`, and the mean weight is the mass of `mu0`. Replicates are independent randomised point sets."""
    points, weight = start_distribution(problem).draw(count, replicate, seed, extra)
    return points, weight * problem.initial_density(points[:, : problem.dim])


def drawn_starts(problem: Problem, count: int, seed: int) -> Tensor:
    """``count`` starts ``(count, d)`` from `mu0`, all of the same weight: weighted starts, resampled by their weight."""
    x, weight = initial_points(problem, CANDIDATES * count, 0, seed)
    if not float(weight.sum()) > 0.0:
        return x[:count]
    generator = torch.Generator().manual_seed(derive_seed(seed, Branch.DRAWN_STARTS, count))
    return x[torch.multinomial(weight, count, replacement=True, generator=generator)]


def fits(problem: Problem) -> tuple[Mixture, Mixture]:
    """The densities fitted to `mu0` and to `f`; computed once for a problem."""
    kept = vars(problem)
    if "_fits" not in kept:
        everywhere = getattr(problem.initial_density, "__func__", None) is Problem.initial_density
        fit = partial(
            fitted_mixture, dim=problem.dim, scanned=SIMULATOR_SCANNED if isinstance(problem, Simulator) else SCANNED
        )
        density = (
            Mixture.uniform(problem.dim) if everywhere else problem.initial_mixture or fit(problem.initial_density)
        )
        kept["_fits"] = density, fit(problem.state_cost, broad=BROAD_COST)
    return kept["_fits"]
