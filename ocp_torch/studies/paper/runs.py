"""The numerical section's recipes, all on the circle with `rho = 2`, `M = 2`, `C_V = 2`, regularity 2, from zero; and what
they give: the measured curves, the fields to draw, the exact kernel beside its truncation, and costs."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from ocp_torch.fields import Fields
from ocp_torch.fields.sobolev import SobolevFeatures
from ocp_torch.problems import Circle
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.studies.benchmark.contenders import OCCUPATION, SCHEDULE
from ocp_torch.studies.benchmark.measure import Judge, relative
from ocp_torch.studies.kernel.expansions import BernoulliKernel
from ocp_torch.studies.kernel.iterations import Iteration, step_sizes

Tick = Callable[[int], None]

# Parts of a window whose time is taken.
PARTS = 5


@dataclass(frozen=True)
class Recipe:
    """``looks`` are the step counts at which the averages are measured, ``drawn`` those at which they are drawn. ``numbers``
    are the method's own, in the order of the keys of `figures.LABELS`. The table has the step counts that ``known`` has: what
    an independent re-implementation found there, in per cent of `OPT`, as ranges over seeds."""

    method: str
    section: str
    numbers: tuple[str, ...]
    step: float
    looks: tuple[int, ...]
    drawn: tuple[int, ...]
    known: dict[int, dict[str, tuple[float, float]]]

    @property
    def steps(self) -> int:
        return self.looks[-1]

    @property
    def sizes(self) -> np.ndarray:
        """The step size of each step."""
        return step_sizes(self.step, self.steps, SCHEDULE[self.method])


SHORT, SHORT_DRAWN = (200, 500, 1000, 2000, 5000, 10000, 15000, 20000), (500, 2000, 5000, 20000)
LONG, LONG_DRAWN = tuple(10 * n for n in SHORT), (2000, 20000, 100000, 200000)
KNOWN: dict[str, dict[int, dict[str, tuple[float, float]]]] = {
    "dual": {5000: {"F_M": (-5.6, -5.3), "value": (2.1, 2.1)}, 20000: {"F_M": (-2.6, -2.5), "value": (0.9, 0.9)}},
    "primal": {5000: {"G": (0.6, 0.9)}, 20000: {"G": (0.17, 0.20)}},
    "pd": {
        200000: {"F_M": (-13.0, -10.0), "J": (84.0, 93.0), "G": (0.7, 0.9), "value": (0.8, 0.9), "density": (0.0, 0.1)}
    },
}
RECIPES = {
    "dual": Recipe("dual", "4.4", ("F_M", "value"), 5e-4, SHORT, SHORT_DRAWN, KNOWN["dual"]),
    "primal": Recipe("primal", "5.6", ("G", "density"), 2e-3, SHORT, SHORT_DRAWN, KNOWN["primal"]),
    "pd": Recipe("pd", "6.3", ("F_M", "J", "G", "value", "density"), 1e-3, LONG, LONG_DRAWN, KNOWN["pd"]),
}


def circle() -> tuple[Circle, Constants]:
    """The paper's example and its constants."""
    problem = Circle(discount=2.0)
    return problem, resolve_constants(problem, occupation_bound=2.0, value_bound=2.0)


@dataclass
class History:
    """One recipe's numbers, per cent of `OPT`, at ``[look][seed]``; the first seed's fields to draw; CPU seconds."""

    recipe: Recipe
    numbers: dict[int, list[dict[str, float]]] = field(default_factory=dict)
    fields: dict[int, Fields] = field(default_factory=dict)
    train_seconds: float = 0.0
    measure_seconds: float = 0.0


def carry_out(recipe: Recipe, seeds: tuple[int, ...], modes: int, tick: Tick = lambda steps: None) -> History:
    """All ``seeds`` of one recipe at once, with truncated features. ``tick`` is told the steps made."""
    problem, constants = circle()
    iteration = Iteration(problem, recipe.method, constants, seeds, features=SobolevFeatures(1, modes=modes))
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
            measured = judge(fields, OCCUPATION[recipe.method])
            history.numbers[look].append({k: relative(v, problem.exact_optimum) for k, v in measured.items()})
            if run == 0 and look in recipe.drawn:
                history.fields[look] = fields
        history.train_seconds += trained - started
        history.measure_seconds += time.process_time() - trained
    return history


@dataclass(frozen=True)
class Comparison:
    """The exact kernel beside its truncation on the same samples: how far the averaged fields are apart, and the cost."""

    method: str
    steps: int
    modes: int
    differences: dict[str, float]  # field -> largest difference on a grid, relative to the field's largest value
    costs: dict[str, list[tuple[int, float]]]  # exact, truncated -> n, and CPU seconds per step there


def compare_with_exact(
    recipe: Recipe, steps: int, modes: int, seed: int, windows: int = 10, tick: Tick = lambda steps: None
) -> Comparison:
    """The first ``steps`` of a recipe in both forms, timed over consecutive ``windows``."""
    problem, constants = circle()
    make = lambda **form: Iteration(problem, recipe.method, constants, (seed,), **form)
    exact = make(kernel=BernoulliKernel(2), capacity=2 * steps)
    truncated = make(features=SobolevFeatures(1, modes=modes))
    forms = ("exact", exact), ("truncated", truncated)
    costs = {name: timed(form, recipe.sizes[:steps], windows, tick) for name, form in forms}
    grid = np.linspace(0.0, 1.0, 201)[None, :, None]
    differences = {}
    for name, network in truncated.fields(0).networks.items():
        there = exact.expansions[name].at(grid, average=True)[0, :, 0, 0]
        here = network(torch.from_numpy(grid[0])).reshape(-1).numpy()
        differences[name] = float(np.abs(there - here).max() / np.abs(there).max())
    return Comparison(recipe.method, steps, modes, differences, costs)


def timed(iteration: Iteration, sizes: np.ndarray, windows: int, tick: Tick) -> list[tuple[int, float]]:
    """Make all steps; at the end of each window, `n` and the CPU seconds per step of its fastest part.

    The fastest of `PARTS`, because whatever else a machine does only ever slows a part down.
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
