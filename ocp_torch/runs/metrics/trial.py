"""The controller, no control and a classical controller, each simulated from the same random starts."""

import json
import logging
import math
from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor

from ocp_torch.compute.background import BackgroundResult
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.files.storage import write_atomically
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced
from ocp_torch.problems.starts import drawn_starts, starts_narrowly
from ocp_torch.runs.metrics.classical import classical_policy
from ocp_torch.runs.metrics.measures import admissible, has_metrics, measure, simulate

log = logging.getLogger(__name__)
METRICS = "metrics.json"
# Starts of a trial: a part of 512 has a standard error of at most 2.2 %.
STARTS = 512
# The time of a trial in units of 1 / rho; the discount of what comes later is below e^-8.
TRIAL = 8.0
# Steps of a trial, at least: 30 per 1 / rho.
STEPS = 240
# More steps are taken where a coordinate would else move by more than this part of a turn in a step, without control and at
# the median state.
LONGEST_STEP = 0.05
# States that the median is taken over.
PACE_STATES = 2**10
CANDIDATES = 64  # uniform states drawn for each start, of which admissible ones are taken
DRAWN = 4  # states from `mu0` drawn instead where it is narrow or in a box


def write_metrics(problem: Problem, policy: Policy, seed: int, folder: Path | None) -> dict | None:
    """Print the metrics of ``policy``, write them as `metrics.json` in ``folder`` and return them; `None` for a problem
    without metrics."""
    found = metrics(problem, policy, derive_seed(seed, Branch.METRICS))
    if found is None:
        return None
    log.info("\n%s", metrics_table(found))
    if folder is not None:
        write_atomically(folder / METRICS, lambda path: path.write_text(json.dumps(found, indent=2) + "\n"))
    return found


def metrics(problem: Problem, policy: Policy, seed: int = 0, starts: int = STARTS) -> dict | None:
    """``controller``, ``zero`` and ``classical`` (where there is one), each with its metrics and mean discounted ``cost``.

    All are simulated from the same ``starts`` (`random_starts`), for ``duration`` in the problem's unit of time; `None` for a
    problem without metrics. Statistics, not bounds: a part `p` has the standard error `sqrt(p (1 - p) / starts)`.
    """
    if not has_metrics(problem):
        return None
    x0 = random_starts(problem, starts, seed)
    duration = TRIAL / problem.discount
    steps = max(STEPS, math.ceil(duration * _pace(problem) / LONGEST_STEP))
    classical = classical_policy(problem)
    policies = {"controller": policy, "zero": zero_policy(problem)} | ({"classical": classical} if classical else {})
    # Classical policies ignore limits of the control, and others round; a held policy is within them.
    cut = lambda each: lambda x: problem.control_cost.within(each(x), torch.ones_like(x[:, 0]))
    within = lambda each: each if isinstance(each, HeldPolicy) else cut(each)

    def measured(names: Iterable[str]) -> dict:
        found = {}
        for name in names:
            path = simulate(problem, within(policies[name]), x0, duration, steps)
            found[name] = {**(measure(problem, path) or {}), "cost": float(path.cost.mean())}
        return found

    others = BackgroundResult(lambda: measured(name for name in policies if name != "controller"), problem)
    with others.ahead(problem.copyable):
        found = measured(["controller"]) | others.answer()
    return {"starts": starts, "seed": seed, "duration": duration, **found}


def random_starts(problem: Problem, count: int, seed: int) -> Tensor:
    """Starts ``(count, d)``, float64: from `mu0` where it is narrow or in a box, else uniform; admissible if enough are."""
    own_start = replaced(problem, "initial_density", System)
    boxed = isinstance(problem, System) and bool(problem.chart.boxed) and not own_start
    if boxed or starts_narrowly(problem):
        x = drawn_starts(problem, DRAWN * count, seed)
    else:
        generator = torch.Generator().manual_seed(seed)
        x = torch.rand(CANDIDATES * count, problem.dim, generator=generator, dtype=torch.float64)
    fair = x[admissible(problem, x)]
    return (fair if len(fair) >= count else x)[:count]


def _pace(problem: Problem) -> float:
    """Turns per unit of time of the fastest coordinate without control, the median over states."""
    (drift,) = problem.probe(PACE_STATES, 0, "a")
    return float(drift.abs().amax(dim=-1).median())


def metrics_table(found: dict) -> str:
    """The metrics as a table for the terminal: a row for each controller."""
    rows = {name: found[name] for name in ("controller", "zero", "classical") if name in found}
    names = list(rows["controller"])
    lines = [f"{found['starts']} random starts, {found['duration']:g} units of time"]
    lines.append(" " * 12 + "".join(f"{name:>14}" for name in names))
    lines += [f"{row:<12}" + "".join(f"{rows[row][name]:>14.4g}" for name in names) for row in rows]
    return "\n".join(lines)
