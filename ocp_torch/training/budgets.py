"""Training budgets by dimension, for every field of the configuration that is null: what won in measurements."""

import copy
import math
from dataclasses import dataclass, replace

from ocp_torch.certificate.lower.tightened import plan_of
from ocp_torch.errors import require_choice, require_number, require_section
from ocp_torch.fields import MODELS
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import is_unbounded
from ocp_torch.training.slack_waves import SOUGHT_AT

LEARNING_RATE = 1e-2


@dataclass(frozen=True)
class Budget:
    """One row: up to ``dim`` coordinates, for a run and for the policy evaluation of its certificate."""

    dim: float
    steps: int
    batch: int
    good_gap: float
    stage_steps: int
    newton_steps: int = 0
    newton_after: int = 0
    stage_lr: float = 1e-2
    lr: float = LEARNING_RATE  # where M is known


# Many dimensions want samples, and a slower fit of the density: in 16 one at 1e-2 ends flat (mean |r| .12, like mu = 1), one
# at 5e-3 does not (.05). In two a second round starts at .3 %: a noisy pendulum had .53 % after one, .28 % after two. In
# eight one run of twelve at 1e-2 lost what it had learnt once hardly a slack was above 0 and gradients were small: F_M ended
# .044 % below OPT, at 5e-3 .0014 %. Where nothing is lost 5e-3 costs little: .0013 for .0009, .0014 for .0008 %.
# Beside kinks the number of steps counts: on a torus in two dimensions the certified gap is .031 to .064 % after 1,100 steps
# of 512 states, .034 to .057 after 1,600 of 256, .032 to .046 after 1,600 of 384 and .032 to .040 after 2,000 of 256 (four
# seeds; 19.5, 20.8 and 22.5 s alone; the last takes .5 to 1.7 s longer than the third, with `pd` 2 s).
# Gauss-Newton steps on V end a round, and are tried just after waves of V were sought for the first time or the second: where
# V is smooth they then find it to 1e-5 of the cost (seed 3202: 1-d 7 steps, 2-d 10, 8-d 17, 16-d 18, 32-d 17; 2-d after 100
# steps 18; in 64-d, after 100, slacks of 1 are left at a few states), and beside kinks one or a dozen show that it is not.
# Whole runs in 4-d take 19 to 21 s where they are tried after 100 steps (three seeds), 21 and 25 after 200 (two).
FIRST, SECOND = SOUGHT_AT[0] + 1, SOUGHT_AT[1] + 1
BUDGETS = (
    Budget(1, steps=1050, batch=256, good_gap=0.005, stage_steps=150, newton_steps=40, newton_after=FIRST),
    Budget(2, steps=1600, batch=384, good_gap=0.003, stage_steps=200, newton_steps=40, newton_after=SECOND),
    Budget(4, steps=1000, batch=384, good_gap=0.005, stage_steps=300, newton_steps=40, newton_after=FIRST),
    Budget(8, steps=1000, batch=512, good_gap=0.01, stage_steps=300, newton_steps=40, newton_after=FIRST, lr=5e-3),
    Budget(
        math.inf,
        steps=1200,
        batch=512,
        good_gap=0.02,
        stage_steps=400,
        newton_steps=40,
        newton_after=SECOND,
        stage_lr=5e-3,
    ),
)
# Before V is near V* they do not converge: there are none after a shorter round.
FEWEST_STEPS = 100

# Where no M is known the bound is decided by the worst state: that wants more states at once, and, without noise, longer.
# Without noise `V` is trained on for its bound afterwards, on batches of its own, and half of the states will do: the bounds
# of a unicycle, dubins, an arm and six oscillators (a seed each) with 1,024, 512 and 256 states were 1.294, 1.299, 1.298;
# 1.147, 1.151, 1.150; .4609, .4606, .4606; .6486, .6482, .643, their performances 1.3086, 1.3091, 1.3102; 1.1615, 1.1616,
# 1.1623; .4629, .4632, .4635; .6556, .6560, .6570, in 15, 10 and 7 ms a step. With noise a unicycle's certified gap was 4.4 %
# with 1,024 and 4.5 % with 512.
# With noise two and three coordinates want less: after rounds of 600 and 1,200 steps a pendulum's certified gap is .55 % and
# an arm's 1.0 % at 1e-3, after 900 and 1,800 .45 and .85 %, for 25 s more of 145; dubins has 6.1 (simulated 1.33) after 900
# and 1,800, 6.8 (1.40) after 1,200 and 2,400; a unicycle 3.0 (1.26) after 900 and
# 1,800, 3.5 (1.19) after 800 and 1,600.
NOISY_BATCH, LARGE_BATCH, MANY_STEPS, FEW_STEPS = 1024, 512, 1200, {2: 600, 3: 800}
# With noise and a known M: in one dimension, where networks are given more modes, and in two, where nothing has a kink.
NOISY_STEPS = {1: 2000, 2: 1100}
# The larger batch is for the supremum of the slack, of which the density player of pd knows nothing.
DENSITY_BATCH = 256
# Evenly spread states leave more steep spots than independent ones, and the worst state is in one.
SAMPLER, WORST_STATE_SAMPLER = "sobol", "uniform"
# States at which a certificate computes the occupation density, and at most so many differences at them, `d + 1` for each:
# with 64 coordinates 144 states took eight of a certificate's twelve minutes, with 16 a third of a minute and a half.
OCCUPATION_STATES, OCCUPATION_DIFFERENCES = 144, 144 * 9
# Of value iteration before training, at most.
WARM_ROUNDS = 120
# By how much the steps of all parts that are left null may be multiplied together: a file may ask for 40 times as many.
EFFORTS = dict(at_least=0.01, at_most=30.0)
# Steps between looks at most, and where one of them may end the run. A look with noise takes as long as 100 to 200 steps;
# every 600 steps they were a third of the training of a pendulum.
LOOKS_APART, TARGET_APART = 1200, 600


def fill(config: dict, problem: Problem) -> dict:
    """``config`` with the fields that are null, and have a default by dimension, filled in.

    Sizes of the networks are those that the class of the model has for itself. Raises `InputError` for a model that is not
    known, or a section that is none.
    """
    for name in ("model", "trainer", "optimizer", "certificate"):
        require_section(name, config.get(name))
    filled = copy.deepcopy(config)
    budget = next(b for b in BUDGETS if problem.dim <= b.dim)
    effort = require_number("trainer.effort", config["trainer"].get("effort", 1.0), **EFFORTS)
    scaled = lambda steps: max(1, round(effort * steps))
    method = require_section("method", config.get("method") or {})
    model = MODELS[require_choice("model.name", config["model"].get("name"), MODELS)]
    unbounded = is_unbounded(problem, method.get("occupation_bound"))
    method_name = method.get("name")
    ours = config["optimizer"].get("name") == "soap" and model is MODELS["mlp"]
    if not ours or problem.noisy or unbounded or not problem.has_simulator:
        budget = replace(budget, newton_steps=0, newton_after=0)
    if problem.noisy:
        budget = replace(budget, steps=NOISY_STEPS.get(problem.dim, budget.steps))
    if unbounded:
        steps = FEW_STEPS.get(problem.dim, budget.steps) if problem.noisy else MANY_STEPS
        batch = NOISY_BATCH if problem.noisy or not problem.has_simulator else LARGE_BATCH
        budget = replace(budget, batch=max(budget.batch, batch), steps=steps)
    defaults: dict[str, object] = {
        **{f"model.{name}": value for name, value in model.defaults(problem.dim, unbounded, problem.noisy).items()},
        "trainer.rounds": 2 if config["trainer"].get("steps") is None else 1,
        "trainer.good_gap": budget.good_gap,
        "trainer.steps": scaled(budget.steps),
        "trainer.batch": budget.batch,
        "optimizer.lr": LEARNING_RATE if unbounded else budget.lr,
        "sampler.name": WORST_STATE_SAMPLER if unbounded else SAMPLER,
        "certificate.occupation_states": min(OCCUPATION_STATES, OCCUPATION_DIFFERENCES // (problem.dim + 1)),
        "certificate.bound_steps": scaled(plan_of(problem, None)[1]),
        "certificate.stage.steps": scaled(budget.stage_steps),
        "certificate.stage.lr": budget.stage_lr,
    }
    if unbounded and method_name == "pd" and config["trainer"].get("batch") is None:
        defaults["method.density_batch"] = DENSITY_BATCH
    given = config["trainer"].get("steps")
    steps = given if isinstance(given, int) and given > 0 else scaled(budget.steps)
    defaults["trainer.newton_steps"] = budget.newton_steps if steps >= FEWEST_STEPS else 0
    early = given is None and method_name == "dual"
    defaults["trainer.newton_after"] = budget.newton_after if early and steps > budget.newton_after else 0
    apart = LOOKS_APART if config["trainer"].get("target_gap") is None else TARGET_APART
    defaults["trainer.evaluate_every"] = math.ceil(steps / math.ceil(steps / apart))
    if config.get("warm_start") is not None:
        defaults["warm_start.rounds"] = scaled(WARM_ROUNDS)
    for path, value in defaults.items():
        *groups, field = path.split(".")
        section = filled
        for depth, group in enumerate(groups, start=1):
            require_section(".".join(groups[:depth]), section.setdefault(group, {}))
            section = section[group]
        if section.get(field) is None:
            section[field] = value
    return filled
