"""Policy evaluation: fit `mu` (and `V`, where there is none) to the closed loop of a controller."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from ocp_torch.certificate.settings import StageSettings
from ocp_torch.certificate.upper.lowered import UNCHANGED, LoweredSlack
from ocp_torch.certificate.upper.multiples import terms_on
from ocp_torch.control.policies import Policy
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

POOL = 2**15  # samples of a closed loop at most, then drawn again: their divergences cost more than a step
# A largest slack above this part of `|E[V mu0]|` is steep, as beside kinks: only the last, longest round is then made.
STEEP = 0.1
# Factor on the batch where the slack is steep: on a torus in two dimensions the Lagrangian bound was .04 % above the optimum
# after 800 steps of 512 states, and .06 % after rounds of 400 and 800 steps of 256.
STEEP_FACTOR = 2
LARGEST_RATIO = 16.0  # of the two suprema of the slack (and its inverse), beyond which the weight of the residual stays
COLLAPSE_STEP = 40  # at which a first round is checked for a collapse to `mu = 0`, where every gradient vanishes
LEAST_MASS = 0.01  # of `mu`: with less the fit is begun anew (dubins with noise: two seeds of three)
RESTART_FACTOR = 0.3  # factor on the learning rate of a fit that is begun anew
LEAST_CHECKED_RATE = 1e-3  # fits at this learning rate or less are not checked for a collapse
ASCENTS = 32  # of either sign to the slack's suprema: in 64 coordinates they found 7, where 4,096 states showed .1
ASCENT_STEPS = 40
EXCESS_STATES = 4096  # at which the excess is computed that says whether a fit is good enough; made at once
# Steps after which the first round may end: in 16 coordinates the bound was 5e-6 above the optimum after 100, 5e-5 after 25.
EXCESS_FIRST = 100
EXCESS_EVERY = 25  # steps between two evaluations of the excess from then on
EARLY_PART = 0.05  # of `good_excess`, at which a first round ends early: any `mu` will do where `V` solves its equation
# That part where the slack is steep: at 1 the circle's certified gap was .002 % wider than after a round of 300 steps.
STEEP_EARLY_PART = 0.5
# Excess half way through the last round at which a fit ends, as what it would come to is of no use either: of dubins, an arm,
# a unicycle, a pendulum and six oscillators the second half took off at most 28 % of it.
HOPELESS = 0.3
# Steps of that round at least: a unicycle's excess was 1.7 after 100, .31 after 200, .15 after 300 and .06 after 1,200.
HOPELESS_AFTER = 250


def fit_closed_loop(
    problem: Problem,
    policy: Policy,
    fields: Fields | None,
    network: Callable[..., torch.nn.Module],
    constants: Constants,
    settings: StageSettings,
    seed: int,
    pool: "Pool | FixedPool | None" = None,
) -> Fields:
    """Fit `log mu^u`, and `V^u` where ``fields`` hold no `V`, to the closed loop of ``policy``; return the fitted fields.

    ``policy`` is made of the trained ``fields``, in their precision; the fit starts from their `log mu`, if any. Without
    ``fields`` the policy is a given one in float64, and both `mu` and `V` are fitted in float32. ``pool`` gives samples of
    the closed loop, by default from evaluations at Sobol points.
    """
    value = None if fields is None else fields.value
    like = torch.zeros(()) if fields is None else next(fields.parameters())
    loop = ClosedLoop(problem, policy)
    count = min(POOL, settings.steps * settings.batch)
    pool = pool or Pool(loop, derive_seed(seed, Branch.POLICY_EVALUATION, 1), like, count, double=fields is None)
    while True:
        start = _start(problem, fields, network, seed).to(like)
        fit = ClosedLoopFit(loop, start, value, pool, constants, settings)
        if fit.done():
            return fit.average.module
        settings = replace(settings, lr=RESTART_FACTOR * settings.lr)


def _start(problem: Problem, fields: Fields | None, network: Callable[..., torch.nn.Module], seed: int) -> Fields:
    """The fields that a fit starts from, see `fit_closed_loop`."""
    value = None if fields is None else fields.value
    names = (LOG_OCCUPATION, VALUE) if value is None else (LOG_OCCUPATION,)
    known = getattr(value, "embedding", None)  # its waves include those found in the slack of V
    waves = known.mixed if isinstance(known, FourierEmbedding) else None
    start = Fields.build(problem, names, network, derive_seed(seed, Branch.POLICY_EVALUATION, 0), waves)
    if fields is not None and fields.log_occupation is not None:
        start.log_occupation.load_state_dict(fields.log_occupation.state_dict())
    return start


class ClosedLoopFit:
    """A fit to ``loop`` from the fields ``start``, at one learning rate. ``value`` is the trained `V`, which stays as it is;
    without one `V^u` is fitted too."""

    def __init__(
        self,
        loop: ClosedLoop,
        start: Fields,
        value: Field | None,
        pool: "Pool | FixedPool",
        constants: Constants,
        settings: StageSettings,
    ) -> None:
        self.loop, self.fitted, self.pool, self.settings = loop, start, pool, settings
        self.judged = pool.samples.take(slice(EXCESS_STATES))
        self.slack = None if value is None else LoweredSlack(loop, value, self.judged)
        if self.slack is not None and loop.problem.has_simulator:
            self.slack.climb(UNCHANGED, ASCENTS, ASCENT_STEPS)
        hi, lo = (0.0, 0.0) if self.slack is None else self.slack.suprema()
        steep = self.slack is not None and max(hi, lo) > STEEP * self.slack.unit
        self.first, self.batch = (settings.rounds - 1, STEEP_FACTOR * settings.batch) if steep else (0, settings.batch)
        self.enough = settings.good_excess * (STEEP_EARLY_PART if steep else EARLY_PART)
        self.phase = Phase(constants)
        objective = PolicyEvaluation(loop, value is None, positive_weight(hi, lo))
        self.stepper, self.average = short_fit(start, objective, settings.lr, settings.steps * 2**self.first)

    def done(self) -> bool:
        """Make the rounds that are needed; false where `mu` collapses to 0."""
        draw = lambda phase: self.pool.draw(self.batch)
        for k in range(self.first, self.settings.rounds):
            steps = self.settings.steps * 2**k
            self.pool.grow(min(POOL, steps * self.batch))
            for step in range(steps):
                advance(self.stepper, self.average, draw, self.phase)
                if k == self.first and self._is_good_after(step + 1):
                    return True
                if k == self.first and step == COLLAPSE_STEP and self._has_collapsed():
                    return False
                late = k == self.settings.rounds - 1 and step + 1 == max(steps // 2, HOPELESS_AFTER)
                if late and self._is_hopeless():
                    return True
            if self._excess() <= self.settings.good_excess:
                break
        return True

    def _is_good_after(self, steps: int) -> bool:
        return steps >= EXCESS_FIRST and steps % EXCESS_EVERY == 0 and self._excess() <= self.enough

    def _is_hopeless(self) -> bool:
        # A `V^u` that is fitted too may have far to go, and `J`, all that recordings have, takes no supremum of the slack.
        known = self.slack is not None and self.loop.problem.has_simulator
        return known and self._excess() > HOPELESS

    def _has_collapsed(self) -> bool:
        return self.settings.lr > LEAST_CHECKED_RATE and vanished(self.fitted.log_occupation, self.judged)

    def _excess(self) -> float:
        """The size of `LoweredSlack.excess`, which is negative where another multiple of `mu` suits a `V` that is far off."""
        fields = self.average.module
        value = self.slack.value if self.slack else fields.value
        terms, *_ = terms_on(Generator.of(self.loop, self.judged), value, fields.log_occupation)
        return abs((self.slack or LoweredSlack(self.loop, value, self.judged)).excess(terms))


@torch.no_grad()
def vanished(log_occupation: Field, samples: Samples) -> bool:
    """Whether the mass of `mu`, by the states of ``samples``, is below `LEAST_MASS`."""
    return float(samples.mean(log_occupation(samples.x).exp())) < LEAST_MASS


class Pool:
    """``count`` samples of a closed loop, made when first drawn, and then drawn again in the same order.

    The loop is evaluated in float64 if ``double``; samples are kept in the precision and on the device of ``like``."""

    def __init__(self, loop: ClosedLoop, seed: int, like: torch.Tensor, count: int, double: bool = False) -> None:
        self.loop, self.like, self.drawn, self.count = loop, like, 0, count
        self.states = SobolSampler(loop.dim, seed, torch.float64 if double else like.dtype)
        self.samples = self._fresh(min(count, EXCESS_STATES))

    def _fresh(self, count: int) -> Samples:
        states = self.states.draw(count).to(self.like.device).split(CHUNK)
        return Samples.concatenate([Samples.of(self.loop, x).to(self.like) for x in states])

    def grow(self, count: int) -> None:
        """Raise the number of samples to ``count``, if it was lower."""
        self.count = max(count, self.count)

    def draw(self, count: int) -> Samples:
        """The next ``count`` samples, after the last the first again: consecutive Sobol points are spread evenly."""
        while len(self.samples) < min(self.drawn + count, self.count):
            missing = min(EXCESS_STATES, self.count - len(self.samples))
            self.samples = Samples.concatenate([self.samples, self._fresh(missing)])
        index = (self.drawn + torch.arange(count, device=self.like.device)) % self.count
        self.drawn += count
        return self.samples.take(index)


class FixedPool:
    """A fixed set of samples that is drawn from with replacement: the `Pool` of a closed loop that cannot be sampled anew."""

    def __init__(self, samples: Samples, seed: int) -> None:
        self.samples = samples
        self.picker = torch.Generator().manual_seed(seed)

    def grow(self, count: int) -> None:
        """Do nothing: the set is fixed."""

    def draw(self, count: int) -> Samples:
        """``count`` samples, drawn with replacement."""
        index = torch.randint(len(self.samples), (count,), generator=self.picker)
        return self.samples.take(index.to(self.samples.x.device))


def positive_weight(hi: float, lo: float) -> float:
    """Weight of a positive residual where a negative one has weight 1: `sqrt(eps_hi / eps_lo)`, the ratio within limits."""
    ratio = max(hi, 1e-30) / max(lo, 1e-30)
    return math.sqrt(min(max(ratio, 1.0 / LARGEST_RATIO), LARGEST_RATIO))
