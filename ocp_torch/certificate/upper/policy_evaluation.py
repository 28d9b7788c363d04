"""Policy evaluation: fit `mu` (and `V`, where there is none) to the closed loop of a controller."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from ocp_torch.certificate.upper.lowered import UNCHANGED, LoweredSlack
from ocp_torch.certificate.upper.multiples import terms_on
from ocp_torch.control.policies import Policy
from ocp_torch.errors import require_integer, require_number
from ocp_torch.fields.embedding import FourierEmbedding
from ocp_torch.fields.fields import LOG_OCCUPATION, VALUE, Fields
from ocp_torch.maths.jets import CHUNK, Field
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives.objective import Phase
from ocp_torch.objectives.policy_evaluation import PolicyEvaluation
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers import advance, short_fit
from ocp_torch.steppers.fitting import LARGEST_RATE

# The closed loop's data are computed once on so many states at most: their divergences cost more than a step.
POOL = 2**15
# Where the slack is more than that part of `|E[V mu0]|`, as beside kinks (1.1 on the circle), only the last and longest round
# is made, on batches so many times as large, and ends as soon as the excess will do: of a torus in two dimensions the
# Lagrangian bound was .04 % above the optimum after 800 steps of 512 states, .06 % after rounds of 400 and 800 of 256, which
# took longer; in three .08 and .12 %.
STEEP, LARGER = 0.1, 2
# Beyond that ratio of the two suprema of the slack the residual is not weighed any more lopsidedly.
MOST_LOPSIDED = 16.0
# Where `mu` is nearly 0 so is every gradient of the fit, and large first steps may lead there (dubins with noise: two seeds
# of three, one for good). A fit is begun anew at so many times its rate, no slower than the last number, if after so many
# steps `mu` has less mass than this.
LOOKED_AT, LEAST_MASS, SLOWER, SLOWEST = 40, 0.01, 0.3, 1e-3
# Ascents of either sign, and their steps: of 64 coordinates the largest slack at 4,096 states was .1 where they found 7.
PEAKS, CLIMBED = 32, 40
# States at which the excess is computed after a round, and that are made at once: what decides need not be exact. In the
# first one that is made it is also looked at after so many steps, and then again after each so many, and the round ends once
# the excess is that part of what is good enough: where the slack is steep the last number (at 1 the circle's certified gap
# was .002 % wider than with a round of 300 steps), elsewhere the other, as any `mu` will do where `V` solves its equation.
# After 25 steps that is so already (an excess of 5e-6 in 16 coordinates), but where the certificate then finds spikes of the
# slack the bound was 5e-5 above the optimum, after 100 steps 5e-6.
EXCESS_STATES, EXCESS_FIRST, EXCESS_EVERY, EXCELLENT, GOOD = 4096, 100, 25, 0.05, 0.5


@dataclass(frozen=True)
class StageSettings:
    """Budget of policy evaluation, `certificate.stage` of a configuration. Raises `InputError` on a wrong value."""

    steps: int = 300  # least-squares steps in the first round; 0 for none at all
    rounds: int = 3  # at most, each twice as long as the one before; beside kinks the last one alone
    good_excess: float = 1e-4  # part of the Lagrangian bound that comes from the residual, below which rounds end
    batch: int = 256  # states per step; beside kinks `LARGER` times as many
    lr: float = 1.0e-2  # learning rate, with cosine decay in each round

    def __post_init__(self) -> None:
        require_integer("certificate.stage.steps", self.steps, 0)
        require_integer("certificate.stage.rounds", self.rounds, 1, maximum=16)
        require_number("certificate.stage.good_excess", self.good_excess, above=0.0)
        require_integer("certificate.stage.batch", self.batch, 1)
        require_number("certificate.stage.lr", self.lr, above=0.0, at_most=LARGEST_RATE)


def fit_closed_loop(
    problem: Problem,
    policy: Policy,
    fields: Fields | None,
    network: Callable[..., torch.nn.Module],
    constants: Constants,
    settings: StageSettings,
    seed: int,
    pool: "Pool | Drawn | None" = None,
) -> Fields:
    """Fields with `log mu^u`, and with `V^u` where ``fields`` hold no `V`, of the closed loop of ``policy``.

    ``fields`` are the trained ones, ``policy`` one of theirs in their precision; their `log mu`, if any, is the start. With
    no ``fields`` the policy is somebody's own, in float64, and both `mu` and `V` are fitted in float32. ``pool``
    is where samples of the closed loop come from, by default from evaluations at Sobol points.
    """
    trained = None if fields is None else fields.value
    like = torch.zeros(()) if fields is None else next(fields.parameters())
    loop = ClosedLoop(problem, policy)
    names = (LOG_OCCUPATION, VALUE) if trained is None else (LOG_OCCUPATION,)
    known = getattr(trained, "embedding", None)  # has the waves that were found in the slack of V too
    waves = known.mixed if isinstance(known, FourierEmbedding) else None
    fitted = Fields.build(problem, names, network, derive_seed(seed, Branch.POLICY_EVALUATION, 0), waves).to(like)
    if fields is not None and fields.log_occupation is not None:
        fitted.log_occupation.load_state_dict(fields.log_occupation.state_dict())
    count = min(POOL, settings.steps * settings.batch)
    pool = pool or Pool(loop, derive_seed(seed, Branch.POLICY_EVALUATION, 1), like, count, double=fields is None)
    judged = pool.samples.take(slice(EXCESS_STATES))
    fixed = None if trained is None else LoweredSlack(loop, trained, judged)
    if fixed is not None and problem.has_simulator:
        fixed.climb(UNCHANGED, PEAKS, CLIMBED)
    hi, lo = (0.0, 0.0) if fixed is None else fixed.suprema()
    steep = fixed is not None and max(hi, lo) > STEEP * fixed.unit
    first, batch = (settings.rounds - 1, LARGER * settings.batch) if steep else (0, settings.batch)
    enough = settings.good_excess * (GOOD if steep else EXCELLENT)
    draw = lambda phase: pool.draw(batch)
    objective, phase = PolicyEvaluation(loop, trained is None, positive_weight(hi, lo)), Phase(constants)
    stepper, average = short_fit(fitted, objective, settings.lr, settings.steps * 2**first)

    def excess() -> float:
        """Below 0 it is where another multiple of `mu` serves a `V` that is far off."""
        value, log_mu = fixed.value if fixed else average.module.value, average.module.log_occupation
        terms, *_ = terms_on(Generator.of(loop, judged), value, log_mu)
        return abs((fixed or LoweredSlack(loop, value, judged)).excess(terms))

    for k in range(first, settings.rounds):
        steps = settings.steps * 2**k
        pool.grow(min(POOL, steps * batch))
        for step in range(steps):
            advance(stepper, average, draw, phase)
            due = k == first and step + 1 >= EXCESS_FIRST and (step + 1) % EXCESS_EVERY == 0
            if due and excess() <= enough:
                return average.module
            looked_at = k == first and step == LOOKED_AT and settings.lr > SLOWEST
            if looked_at and vanished(fitted.log_occupation, judged):
                slower = replace(settings, lr=SLOWER * settings.lr)
                return fit_closed_loop(problem, policy, fields, network, constants, slower, seed, pool)
        if excess() <= settings.good_excess:
            break
    return average.module


@torch.no_grad()
def vanished(log_occupation: Field, samples: Samples) -> bool:
    """Whether hardly any mass of `mu` is left at the states of ``samples``."""
    return float(samples.mean(log_occupation(samples.x).exp())) < LEAST_MASS


class Pool:
    """``count`` samples of a closed loop that are made as they are drawn, and then drawn again and again.

    The loop is evaluated in float64 if ``double``; samples are kept in the precision and on the device of ``like``."""

    def __init__(self, loop: ClosedLoop, seed: int, like: torch.Tensor, count: int, double: bool = False) -> None:
        self.loop, self.like, self.drawn, self.count = loop, like, 0, count
        self.states = SobolSampler(loop.dim, seed, torch.float64 if double else like.dtype)
        self.samples = self._fresh(min(count, EXCESS_STATES))

    def _fresh(self, count: int) -> Samples:
        states = self.states.draw(count).to(self.like.device).split(CHUNK)
        return Samples.concatenate([Samples.of(self.loop, x).to(self.like) for x in states])

    def grow(self, count: int) -> None:
        """``count`` in all from now on, if they were fewer."""
        self.count = max(count, self.count)

    def draw(self, count: int) -> Samples:
        """The next ``count`` of them, round and round: consecutive Sobol points are spread evenly."""
        while len(self.samples) < min(self.drawn + count, self.count):
            missing = min(EXCESS_STATES, self.count - len(self.samples))
            self.samples = Samples.concatenate([self.samples, self._fresh(missing)])
        index = (self.drawn + torch.arange(count, device=self.like.device)) % self.count
        self.drawn += count
        return self.samples.take(index)


class Drawn:
    """A fixed set of samples that is drawn from with replacement: the `Pool` of a closed loop that cannot be sampled anew."""

    def __init__(self, samples: Samples, seed: int) -> None:
        self.samples = samples
        self.picker = torch.Generator().manual_seed(seed)

    def grow(self, count: int) -> None:
        """There are no more."""

    def draw(self, count: int) -> Samples:
        """``count`` of them."""
        index = torch.randint(len(self.samples), (count,), generator=self.picker)
        return self.samples.take(index.to(self.samples.x.device))


def positive_weight(hi: float, lo: float) -> float:
    """What a positive residual should weigh where a negative one weighs 1: the root of `eps_hi / eps_lo`, within limits."""
    ratio = max(hi, 1e-30) / max(lo, 1e-30)
    return math.sqrt(min(max(ratio, 1.0 / MOST_LOPSIDED), MOST_LOPSIDED))
