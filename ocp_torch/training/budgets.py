"""Training budgets by dimension, for every field of the configuration that is null: the best ones measured."""

import copy
import math
from dataclasses import dataclass, replace

from ocp_torch.certificate.lower.tightened import plan_of
from ocp_torch.errors import require_choice, require_number, require_section
from ocp_torch.fields import MODELS
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import is_unbounded
from ocp_torch.training.slack_waves import WAVE_SEARCH_STEPS

LEARNING_RATE = 1e-2


@dataclass(frozen=True)
class Budget:
    """Defaults for a run, and for the policy evaluation (stage) of its certificate, with at most ``dim`` coordinates."""

    dim: float
    steps: int  # of the first round
    batch: int
    good_gap: float  # relative gap that needs no second round
    stage_steps: int
    newton_steps: int = 0  # Gauss-Newton steps at most, at the end of a round and early
    newton_after: int = 0  # steps of the first round after which they are tried early
    stage_lr: float = 1e-2
    lr: float = LEARNING_RATE  # where M is known


# Gauss-Newton steps are tried just after missed waves of V were sought for the first or the second time: they then find a
# smooth V to 1e-5 of the cost in 7 to 18 steps (1 to 32 dimensions), and a dozen show that there is none beside kinks.
FIRST_WAVES = WAVE_SEARCH_STEPS[0] + 1
SECOND_WAVES = WAVE_SEARCH_STEPS[1] + 1
# Two dimensions: beside kinks steps count more than states (a torus has a gap of .046 % or less after 1,600 steps of 384, of
# up to .064 % after 1,100 of 512). Eight: at a rate of 1e-2 one run of twelve lost what it had learnt (F_M ended .044 % below
# OPT, at 5e-3 .0014 %). More: in 16 a density fitted at 1e-2 stays flat (mean residual .12), at 5e-3 it does not (.05).
BUDGETS = (
    Budget(1, steps=1050, batch=256, good_gap=0.005, stage_steps=150, newton_steps=40, newton_after=FIRST_WAVES),
    Budget(2, steps=1600, batch=384, good_gap=0.003, stage_steps=200, newton_steps=40, newton_after=SECOND_WAVES),
    Budget(4, steps=1000, batch=384, good_gap=0.005, stage_steps=300, newton_steps=40, newton_after=FIRST_WAVES),
    Budget(
        8, steps=1000, batch=512, good_gap=0.01, stage_steps=300, newton_steps=40, newton_after=FIRST_WAVES, lr=5e-3
    ),
    Budget(
        math.inf,
        steps=1200,
        batch=512,
        good_gap=0.02,
        stage_steps=400,
        newton_steps=40,
        newton_after=SECOND_WAVES,
        stage_lr=5e-3,
    ),
)
# Before V is near V* Gauss-Newton steps do not converge: there are none after a shorter round.
LEAST_STEPS_FOR_NEWTON = 100

# Where no M is known (unbounded) the worst state decides the bound, which takes more states and, without noise, more steps.
UNBOUNDED_BATCH = 512  # a unicycle's bound was 1.299, with 1,024 it was 1.294
UNBOUNDED_STEPS = 1200
NOISY_UNBOUNDED_BATCH = 1024  # or with recorded samples; a noisy unicycle's gap was 4.4 %, with 512 it was 4.5 %
# By dimension: a pendulum's gap was .55 % after rounds of 600 and 1,200 steps, .45 % after 900 and 1,800 in 25 s more of 145.
NOISY_UNBOUNDED_STEPS = {2: 600, 3: 800}
# With noise otherwise: more in one dimension, where networks have more modes, fewer in two, where nothing has a kink.
NOISY_STEPS = {1: 2000, 2: 1100}
DENSITY_BATCH = 256  # states for the density player of pd: more serve the supremum of a slack that it does not see
SAMPLER = "sobol"
WORST_STATE_SAMPLER = "uniform"  # evenly spread states leave more steep spots, and the worst state is in one
OCCUPATION_STATES = 144  # at which a certificate computes the occupation density
# Differences at these states at most, `d + 1` for each: with 64 coordinates 144 states took eight minutes of twelve.
OCCUPATION_DIFFERENCES = 144 * 9
WARM_ROUNDS = 120  # of value iteration before training, at most
# Simulated starts per replicate, and the fewest with a trainer.effort below 1; powers of 2, over which Sobol points are
# balanced. With 128 of them Perf of unicycles was known to .07 to .14 %, with 256 to .05 to .08 %.
TRAJECTORIES = 256
FEWEST_TRAJECTORIES = 32
# Range of trainer.effort, which multiplies all numbers of steps that are null: a file may ask for 40 times as many.
EFFORTS = dict(at_least=0.01, at_most=30.0)
# Steps between quick evaluations at most: with noise each takes as long as 100 to 200 steps.
EVALUATE_EVERY = 1200
EVALUATE_EVERY_FOR_TARGET = 600  # where an evaluation may end the run


def fill(config: dict, problem: Problem) -> dict:
    """``config`` with the fields that are null, and have a default by dimension, filled in.

    Sizes of the networks are the defaults of the model's class. Raises `InputError` for a model that is not known, or where
    a section is no group of fields.
    """
    for name in ("model", "trainer", "optimizer", "certificate"):
        require_section(name, config.get(name))
    filled = copy.deepcopy(config)
    method = require_section("method", config.get("method") or {})
    model = MODELS[require_choice("model.name", config["model"].get("name"), MODELS)]
    unbounded = is_unbounded(problem, method.get("occupation_bound"))
    swept = config["optimizer"].get("name") == "soap" and model is MODELS["mlp"]
    budget = _budget(problem, unbounded, solvable=swept and problem.has_simulator)
    defaults = {
        **{f"model.{name}": value for name, value in model.defaults(problem.dim, unbounded, problem.noisy).items()},
        "optimizer.lr": LEARNING_RATE if unbounded else budget.lr,
        "sampler.name": WORST_STATE_SAMPLER if unbounded else SAMPLER,
        **_efforts(config, problem, budget),
    }
    if unbounded and method.get("name") == "pd" and config["trainer"].get("batch") is None:
        defaults["method.density_batch"] = DENSITY_BATCH
    for path, value in defaults.items():
        _put(filled, path, value)
    return filled


def _budget(problem: Problem, unbounded: bool, solvable: bool) -> Budget:
    """The row for ``problem``; Gauss-Newton steps only where `V` is smooth, and ``solvable`` by them."""
    budget = next(b for b in BUDGETS if problem.dim <= b.dim)
    if not solvable or problem.noisy or unbounded:
        budget = replace(budget, newton_steps=0, newton_after=0)
    if problem.noisy:
        budget = replace(budget, steps=NOISY_STEPS.get(problem.dim, budget.steps))
    if unbounded:
        steps = NOISY_UNBOUNDED_STEPS.get(problem.dim, budget.steps) if problem.noisy else UNBOUNDED_STEPS
        batch = NOISY_UNBOUNDED_BATCH if problem.noisy or not problem.has_simulator else UNBOUNDED_BATCH
        budget = replace(budget, batch=max(budget.batch, batch), steps=steps)
    return budget


def _efforts(config: dict, problem: Problem, budget: Budget) -> dict[str, object]:
    """How long each part goes on, by the path of its field; steps are multiplied by `trainer.effort`, and so are simulated
    starts, which no effort raises."""
    trainer = config["trainer"]
    effort = require_number("trainer.effort", trainer.get("effort", 1.0), **EFFORTS)
    starts = 2 ** round(math.log2(effort * TRAJECTORIES))
    scaled = lambda steps: max(1, round(effort * steps))
    given = trainer.get("steps")
    steps = given if isinstance(given, int) and given > 0 else scaled(budget.steps)
    early = given is None and (config.get("method") or {}).get("name") == "dual" and steps > budget.newton_after
    apart = EVALUATE_EVERY if trainer.get("target_gap") is None else EVALUATE_EVERY_FOR_TARGET
    warm = {} if config.get("warm_start") is None else {"warm_start.rounds": scaled(WARM_ROUNDS)}
    return {
        "trainer.rounds": 2 if given is None else 1,
        "trainer.good_gap": budget.good_gap,
        "trainer.steps": scaled(budget.steps),
        "trainer.batch": budget.batch,
        "trainer.newton_steps": budget.newton_steps if steps >= LEAST_STEPS_FOR_NEWTON else 0,
        "trainer.newton_after": budget.newton_after if early else 0,
        "trainer.evaluate_every": math.ceil(steps / math.ceil(steps / apart)),
        "certificate.occupation_states": min(OCCUPATION_STATES, OCCUPATION_DIFFERENCES // (problem.dim + 1)),
        "certificate.trajectories": max(FEWEST_TRAJECTORIES, min(starts, TRAJECTORIES)),
        "certificate.bound_steps": scaled(plan_of(problem, None)[1]),
        "certificate.stage.steps": scaled(budget.stage_steps),
        "certificate.stage.lr": budget.stage_lr,
        **warm,
    }


def _put(config: dict, path: str, value: object) -> None:
    """Set the field at ``path`` of ``config``, where it is null."""
    *groups, field = path.split(".")
    for depth, group in enumerate(groups, start=1):
        require_section(".".join(groups[:depth]), config.setdefault(group, {}))
        config = config[group]
    if config.get(field) is None:
        config[field] = value
