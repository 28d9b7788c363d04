"""The recipes of the paper's numerical section, all on the circle with `rho = 2`, `M = 2`, `C_V = 2`, regularity 2, from
zero, and that of the remark on noise, with regularity 3; and their results: measured curves, fields to draw, the exact kernel
beside its truncation, and costs."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ocp_torch.control.policies import trained_policies
from ocp_torch.fields import Fields
from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.problems import Circle
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.studies.benchmark.contenders import OCCUPATION, SCHEDULE
from ocp_torch.studies.benchmark.measure import Judge, relative
from ocp_torch.studies.kernel.bernoulli import BernoulliKernel
from ocp_torch.studies.kernel.iterations import Iteration, step_sizes
from ocp_torch.studies.reference.performance import grid_performance
from ocp_torch.studies.reference.reference import solve_reference

Tick = Callable[[int], None]

# Nodes of the finest grid on which controllers are evaluated where there is noise.
SIDE = 512
# Parts of a window that are timed; the fastest counts.
PARTS = 5


@dataclass(frozen=True)
class Recipe:
    """A run of the paper. ``looks`` are the step counts at which the averages are measured, ``drawn`` those at which they are
    drawn. ``numbers`` are the method's own, in the order of the keys of `figures.LABELS`. ``known`` has, for the step counts
    of the table, the results of an independent re-implementation, in per cent of `OPT`, as ranges over seeds. ``noise`` is
    that of the circle."""

    method: str
    section: str
    numbers: tuple[str, ...]
    step: float
    looks: tuple[int, ...]
    drawn: tuple[int, ...]
    known: dict[int, dict[str, tuple[float, float]]]
    noise: float = 0.0

    @property
    def name(self) -> str:
        return f"{self.method}, noise" if self.noise else self.method

    @property
    def regularity(self) -> int:
        """The regularity of the space: with noise second derivatives must be continuous functionals."""
        return 3 if self.noise else 2

    @property
    def steps(self) -> int:
        return self.looks[-1]

    @property
    def sizes(self) -> np.ndarray:
        """The step size of each step."""
        return step_sizes(self.step, self.steps, SCHEDULE[self.method])


# Noise of the noisy circle: the kink of `V*` becomes a layer of a tenth of the circle.
NOISE = 1e-2
# Step counts at which short and long runs are measured, and drawn.
SHORT = (200, 500, 1000, 2000, 5000, 10000, 15000, 20000)
SHORT_DRAWN = (500, 2000, 5000, 20000)
LONG = tuple(10 * n for n in SHORT)
LONG_DRAWN = (2000, 20000, 100000, 200000)
KNOWN: dict[str, dict[int, dict[str, tuple[float, float]]]] = {
    "dual": {5000: {"F_M": (-5.6, -5.3), "value": (2.1, 2.1)}, 20000: {"F_M": (-2.6, -2.5), "value": (0.9, 0.9)}},
    "primal": {5000: {"G": (0.6, 0.9)}, 20000: {"G": (0.17, 0.20)}},
    "pd": {
        200000: {"F_M": (-13.0, -10.0), "J": (84.0, 93.0), "G": (0.7, 0.9), "value": (0.8, 0.9), "density": (0.0, 0.1)}
    },
}
RECIPES = {
    "dual": Recipe("dual", "4.4", ("F_M", "value"), 5e-4, SHORT, SHORT_DRAWN, KNOWN["dual"]),
    "dual_noise": Recipe("dual", "4.3", ("F_M", "value"), 5e-4, SHORT, SHORT_DRAWN, {5000: {}, 20000: {}}, NOISE),
    "primal": Recipe("primal", "5.6", ("G", "density"), 2e-3, SHORT, SHORT_DRAWN, KNOWN["primal"]),
    "pd": Recipe("pd", "6.3", ("F_M", "J", "G", "value", "density"), 1e-3, LONG, LONG_DRAWN, KNOWN["pd"]),
}


def circle(noise: float = 0.0) -> tuple[Circle, Constants]:
    """The paper's example and its constants."""
    problem = Circle(discount=2.0, noise=noise)
    return problem, resolve_constants(problem, occupation_bound=2.0, value_bound=2.0)


class Truth(NamedTuple):
    """`OPT`, and at states ``(N, 1)`` `V*` ``(N,)``, `u*` ``(N, 1)`` and `mu*` ``(N,)``."""

    optimum: float
    at: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]


@cache
def truth(noise: float) -> Truth:
    """The truth on the circle: exact, and with ``noise`` from grids."""
    problem, _ = circle(noise)
    if not problem.noisy:
        assert problem.exact_optimum is not None  # the circle has its exact truth
        return Truth(problem.exact_optimum, partial(_exact, problem))
    reference = solve_reference(problem)

    def at(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        grid, density = reference.solution.grid, reference.solution.occupation
        assert density is not None  # grids give it wherever there is noise
        return *reference.interpolate(x), grid.interpolated(density[:, None], x)[:, 0]

    return Truth(reference.optimum, at)


def _exact(problem: Circle, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    V, u, mu = problem.exact_value(x), problem.exact_control(x), problem.exact_occupation(x)
    assert V is not None
    assert u is not None
    assert mu is not None
    return V, u, mu


@dataclass
class History:
    """One recipe's numbers, per cent of `OPT`, at ``[look][seed]``; the first seed's fields to draw; CPU seconds."""

    recipe: Recipe
    numbers: dict[int, list[dict[str, float]]] = field(default_factory=dict)
    fields: dict[int, Fields] = field(default_factory=dict)
    train_seconds: float = 0.0
    measure_seconds: float = 0.0


def carry_out(recipe: Recipe, seeds: tuple[int, ...], modes: int, tick: Tick = lambda steps: None) -> History:
    """Run all ``seeds`` of one recipe at once, with truncated features. ``tick`` is called with the number of steps made."""
    problem, constants = circle(recipe.noise)
    features = SobolevFeatures(1, recipe.regularity, modes=modes)
    iteration = Iteration(problem, recipe.method, constants, seeds, features=features)
    judge, history, sizes = Judge(problem, constants), History(recipe), recipe.sizes
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
            measured = judge(fields, OCCUPATION[recipe.method], perf=not problem.noisy)
            if problem.noisy:  # a linear equation on grids is cheaper than paths, and exact
                policies = trained_policies(OCCUPATION[recipe.method], problem, fields, constants)
                measured |= {name: grid_performance(problem, policy, SIDE).optimum for name, policy in policies.items()}
            optimum = truth(recipe.noise).optimum
            history.numbers[look].append({k: relative(v, optimum) for k, v in measured.items()})
            if run == 0 and look in recipe.drawn:
                history.fields[look] = fields
        history.train_seconds += trained - started
        history.measure_seconds += time.process_time() - trained
    return history


@dataclass(frozen=True)
class Comparison:
    """The exact kernel beside its truncation on the same samples: differences of the averaged fields, and the cost."""

    method: str
    steps: int
    modes: int
    differences: dict[str, float]  # field -> largest difference on a grid, relative to the field's largest value
    costs: dict[str, list[tuple[int, float]]]  # exact, truncated -> n, and CPU seconds per step there


def compare_with_exact(
    recipe: Recipe, steps: int, modes: int, seed: int, windows: int = 10, tick: Tick = lambda steps: None
) -> Comparison:
    """The first ``steps`` of a recipe in both forms, timed over consecutive ``windows``."""
    problem, constants = circle(recipe.noise)
    make = lambda **form: Iteration(problem, recipe.method, constants, (seed,), **form)
    exact = make(kernel=BernoulliKernel(recipe.regularity), capacity=2 * steps)
    truncated = make(features=SobolevFeatures(1, recipe.regularity, modes=modes))
    forms = ("exact", exact), ("truncated", truncated)
    costs = {name: timed(form, recipe.sizes[:steps], windows, tick) for name, form in forms}
    grid = np.linspace(0.0, 1.0, 201)[None, :, None]
    differences = {}
    for name, network in truncated.fields(0).networks.items():
        there = exact.expansions[name].at(grid, average=True)[0, :, 0, 0]
        here = network(torch.from_numpy(grid[0])).reshape(-1).numpy()
        differences[name] = float(np.abs(there - here).max() / np.abs(there).max())
    return Comparison(recipe.name, steps, modes, differences, costs)


def timed(iteration: Iteration, sizes: np.ndarray, windows: int, tick: Tick) -> list[tuple[int, float]]:
    """Make all steps; at the end of each window, `n` and the CPU seconds per step of its fastest part.

    The fastest of `PARTS` counts, as other work of the machine can only slow a part down.
    """
    costs = []
    for window in np.array_split(sizes, min(windows, len(sizes))):
        per_step = []
        for part in np.array_split(window, min(PARTS, len(window))):
            started = time.process_time()
            iteration.advance(part)
            per_step.append((time.process_time() - started) / len(part))
            tick(len(part))
        costs.append((iteration.n, min(per_step)))
    return costs
