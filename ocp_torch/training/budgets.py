"""Sizes and budgets by dimension, for every field of the configuration that is null: what won in measurements."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from math import inf

from ocp_torch.errors import require_section
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import is_unbounded


@dataclass(frozen=True)
class Budget:
    """One row: up to ``dim`` coordinates, for a run and for the policy evaluation of its certificate."""

    dim: float
    modes: int
    waves: int
    width: int
    gated: bool
    steps: int
    batch: int
    good_gap: float
    stage_steps: int


# Kinks want Fourier modes, affordable in one and two dimensions; many dimensions want samples, and gates: products of tanh
# learn terms that couple many coordinates several times faster.
BUDGETS = (
    Budget(1, modes=6, waves=0, width=96, gated=False, steps=900, batch=256, good_gap=0.005, stage_steps=300),
    Budget(2, modes=6, waves=16, width=96, gated=False, steps=900, batch=256, good_gap=0.005, stage_steps=400),
    Budget(4, modes=3, waves=32, width=128, gated=False, steps=1200, batch=384, good_gap=0.005, stage_steps=600),
    Budget(8, modes=1, waves=64, width=128, gated=True, steps=1000, batch=512, good_gap=0.01, stage_steps=600),
    Budget(inf, modes=1, waves=128, width=128, gated=True, steps=1200, batch=512, good_gap=0.02, stage_steps=800),
)

# Where no M is known the slack must be small everywhere, not on average: that wants more states at once, and longer.
LARGE_BATCH, MANY_WAVES, MANY_STEPS = 1024, 64, 1200
# The larger batch is for the supremum of the slack, of which the density player of pd knows nothing.
DENSITY_BATCH = 256
# And no steep spots that nobody visits, but the supremum does: gelu leaves fewer than tanh, independent states fewer than
# evenly spread ones.
GENTLE_ACTIVATION, GENTLE_SAMPLER = "gelu", "uniform"
ACTIVATION, SAMPLER, LEARNING_RATE = "tanh", "sobol", 1e-2


def fill(config: dict, problem: Problem) -> dict:
    """``config`` with the fields that are null, and have a default by dimension, filled in."""
    budget = next(b for b in BUDGETS if problem.dim <= b.dim)
    for name in ("model", "trainer", "optimizer", "certificate"):
        require_section(name, config.get(name))
    filled = copy.deepcopy(config)
    activation, sampler, of_method = ACTIVATION, SAMPLER, {}
    method = require_section("method", config.get("method") or {})
    if is_unbounded(problem, method.get("occupation_bound")):
        if method.get("name") == "pd" and config["trainer"].get("batch") is None:
            of_method = {("method", "density_batch"): DENSITY_BATCH}
        activation, sampler = ACTIVATION if budget.gated else GENTLE_ACTIVATION, GENTLE_SAMPLER
        budget = replace(
            budget,
            batch=max(budget.batch, LARGE_BATCH),
            waves=max(budget.waves, MANY_WAVES),
            steps=max(budget.steps, MANY_STEPS),
        )
    defaults = {
        ("model", "modes"): budget.modes,
        ("model", "waves"): budget.waves,
        ("model", "width"): budget.width,
        ("model", "gated"): budget.gated,
        ("model", "activation"): activation,
        ("trainer", "rounds"): 2 if config["trainer"].get("steps") is None else 1,
        ("trainer", "good_gap"): budget.good_gap,
        ("trainer", "steps"): budget.steps,
        ("trainer", "batch"): budget.batch,
        ("optimizer", "lr"): LEARNING_RATE,
        ("sampler", "name"): sampler,
        ("certificate", "stage", "steps"): budget.stage_steps,
        **of_method,
    }
    for (*path, name), value in defaults.items():
        # The table's sizes are those of perceptrons; a linear model chooses its own.
        if path == ["model"] and config["model"].get("name") == "sobolev":
            continue
        section = filled
        for depth, key in enumerate(path, start=1):
            require_section(".".join(path[:depth]), section.setdefault(key, {}))
            section = section[key]
        if section.get(name) is None:
            section[name] = value
    return filled
