"""The recipes carried out: the measured curves, the fields to draw, the exact kernel beside its truncation, and costs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from ocp_torch.benchmark.kernels import OCCUPATION
from ocp_torch.benchmark.measure import Judge, relative
from ocp_torch.bounds import Bounds, resolve_bounds
from ocp_torch.fields import Fields
from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.kernel import Iteration
from ocp_torch.kernel.bernoulli import BernoulliKernel
from ocp_torch.paper.recipes import DISCOUNT, OCCUPATION_BOUND, VALUE_BOUND, Recipe
from ocp_torch.problems import Circle

Tick = Callable[[int], None]


def circle() -> tuple[Circle, Bounds]:
    """The paper's example and its constants."""
    problem = Circle(DISCOUNT)
    return problem, resolve_bounds(problem, occupation_bound=OCCUPATION_BOUND, value_bound=VALUE_BOUND)


@dataclass
class History:
    """One recipe's numbers, per cent of `OPT`, at ``[look][seed]``; the first seed's fields to draw; CPU seconds."""

    recipe: Recipe
    numbers: dict[int, list[dict[str, float]]] = field(default_factory=dict)
    fields: dict[int, Fields] = field(default_factory=dict)
    train_seconds: float = 0.0
    measure_seconds: float = 0.0


def carry_out(recipe: Recipe, seeds: tuple[int, ...], modes: int, tick: Tick = lambda steps: None) -> History:
    """All ``seeds`` of one recipe at once, with truncated features. ``tick`` is told the steps made.

    Bounds are measured for every seed at every look; performances, which are simulated, of the first seed at every look
    and of the others where the table wants them.
    """
    problem, bounds = circle()
    iteration = Iteration(problem, recipe.method, bounds, seeds, features=SobolevFeatures(1, modes=modes))
    judge, history, sizes = Judge(problem, bounds), History(recipe), recipe.sizes
    for look in recipe.looks:
        started = time.process_time()
        while iteration.n < look:
            part = sizes[iteration.n : min(iteration.n + 1000, look)]
            iteration.advance(part)
            tick(len(part))
        trained = time.process_time()
        history.numbers[look] = []
        for run in range(len(seeds)):
            fields = iteration.fields(run)
            perf = run == 0 or look in recipe.tabled
            measured = judge(fields, OCCUPATION[recipe.method], perf)
            history.numbers[look].append({k: relative(v, problem.exact_optimum) for k, v in measured.items()})
            if run == 0 and look in recipe.drawn:
                history.fields[look] = fields
        history.train_seconds += trained - started
        history.measure_seconds += time.process_time() - trained
    return history


@dataclass(frozen=True)
class Agreement:
    """How far the averaged fields of the exact kernel and of its truncation are apart on the same samples."""

    method: str
    steps: int
    modes: int
    differences: dict[str, float]  # field -> largest difference on a grid, relative to the field's largest value
    exact_seconds: float
    truncated_seconds: float


def compare_with_exact(recipe: Recipe, steps: int, modes: int, seed: int) -> Agreement:
    """The first ``steps`` of a recipe in both forms."""
    problem, bounds = circle()
    features = SobolevFeatures(1, modes=modes)
    sizes = recipe.sizes[:steps]
    exact = Iteration(problem, recipe.method, bounds, (seed,), kernel=BernoulliKernel(2), capacity=2 * steps)
    truncated = Iteration(problem, recipe.method, bounds, (seed,), features=features)
    seconds = []
    for iteration in (exact, truncated):
        started = time.process_time()
        iteration.advance(sizes)
        seconds.append(time.process_time() - started)
    grid = np.linspace(0.0, 1.0, 201)[None, :, None]
    differences = {}
    for name, network in truncated.fields(0).networks.items():
        there = exact.expansions[name].at(grid, average=True)[0, :, 0, 0]
        here = network(torch.from_numpy(grid[0])).reshape(-1).numpy()
        differences[name] = float(np.abs(there - here).max() / np.abs(there).max())
    return Agreement(recipe.method, steps, modes, differences, *seconds)


def cost_per_step(recipe: Recipe, steps: int, modes: int, window: int) -> dict[str, list[tuple[int, float]]]:
    """CPU seconds per step of both forms, over consecutive windows: ``{"exact": [(n, seconds)], "truncated": ...}``."""
    problem, bounds = circle()
    forms = {
        "exact": dict(kernel=BernoulliKernel(2), capacity=2 * steps),
        "truncated": dict(features=SobolevFeatures(1, modes=modes)),
    }
    measured: dict[str, list[tuple[int, float]]] = {}
    for name, form in forms.items():
        iteration = Iteration(problem, recipe.method, bounds, (0,), **form)
        measured[name] = []
        while iteration.n < steps:
            started = time.process_time()
            iteration.advance(recipe.sizes[iteration.n : iteration.n + window])
            measured[name].append((iteration.n, (time.process_time() - started) / window))
    return measured
