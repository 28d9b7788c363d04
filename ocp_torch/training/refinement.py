"""Gauss-Newton steps by which `V` solves the Hamilton-Jacobi-Bellman equation: early in training, and at each round's end."""

import copy
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ocp_torch.certificate.contexts.fields import in_float64
from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.certificate.settings import Run
from ocp_torch.compute.processes import SingleProcess
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.maths.jets import Field
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import batched, extremes
from ocp_torch.problems import Problem
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.gauss_newton import refined
from ocp_torch.training.evaluator import Evaluator
from ocp_torch.training.settings import TrainerSettings

COMPARISON_STATES = 8192  # the same ones for `F_M` before and after the steps
# States among which ascents to the largest slacks begin: in eight coordinates 4,096 missed a spike of 1e-3 (certified gap
# .010 %), and these found it (.0006 %).
SCANNED_STATES = 16384
ASCENT_STARTS = 16  # of either sign
ASCENT_STEPS = 20
# Root mean squares of the slack, as parts of the mean state cost.
ENOUGH_SLACK = 5e-6  # at which the steps end: `F_M` was then .0001 to .0003 % below OPT
SOLVED_SLACK = 4e-5  # at which training ends: just below it `F_M` was .002 % below OPT


class RefinedValue(NamedTuple):
    """The weights of a refined `V`, and whether it solves the equation."""

    weights: dict
    solved: bool


def refine(
    evaluator: Evaluator, settings: TrainerSettings, run: Run, ranks: SingleProcess, stop: Callable[[], bool]
) -> bool:
    """Refine the averaged `V` that ``evaluator`` judges, from which training goes on, if that helps; and say whether it did.

    It has to be called again where it was told to ``stop``. Before the end of a round it is all or nothing: either the
    equation is solved, and a quick evaluation finds a good gap, so that training is over, or all stays as it was.
    """
    problem, state, started, told = evaluator.problem, evaluator.state, time.perf_counter(), []
    spent = lambda: time.perf_counter() - started

    def stopping() -> bool:
        if stop() or (settings.max_seconds is not None and state.elapsed + spent() >= settings.max_seconds):
            told.append(True)  # not where a request comes after the last step: the steps are then done
        return bool(told)

    early = state.step < settings.end(state.round)
    seed = derive_seed(run.seed, Branch.REFINEMENT, state.round, state.step)
    how = state.constants.M, settings.newton_steps, seed, stopping
    found, drawn = ranks.from_first(lambda: refined_value(problem, evaluator.trained.fields, *how))
    if found is not None and early and not found.solved:
        found = None
    kept = _values(evaluator)
    if found is not None:
        _put(evaluator, [found.weights for _ in kept])
    state.refined = ranks.from_first(lambda: not told)
    state.samples += drawn if state.refined else 0
    state.elapsed += spent()
    if found is not None and early:  # not to be shown: the certificate comes next
        goal = min(settings.good_gap, settings.target_gap or math.inf)
        state.solved = ranks.from_first(lambda: evaluator.reaches(goal, run))
        if not state.solved:
            _put(evaluator, kept)
    return found is not None and (state.solved or not early)


def _values(evaluator: Evaluator) -> list[dict]:
    """The weights of both `V`, of the iterate and of the average; none where there is no `V`."""
    fields = evaluator.state.fields, evaluator.trained.fields
    return [copy.deepcopy(f.value.state_dict()) for f in fields if f.value is not None]


def _put(evaluator: Evaluator, weights: list[dict]) -> None:
    """Give both `V` their ``weights``."""
    for fields, own in zip((evaluator.state.fields, evaluator.trained.fields), weights, strict=True):
        fields.value.load_state_dict(own)
    evaluator.latest = None  # that certificate is of the `V` before


def refined_value(
    problem: Problem, fields: Fields, M: float, steps: int, seed: int, stop: Callable[[], bool]
) -> tuple[RefinedValue | None, int]:
    """What at most ``steps`` steps on the slack of the `V` of ``fields`` find, at evenly spread states of ``seed``, and how
    many states were drawn. `None` where the steps do not help, as beside kinks or with noise, make `F_M` worse, or were told
    to ``stop``."""
    network = fields.value
    ours = isinstance(network, PeriodicMLP) and network.can_be_swept
    if not steps or problem.noisy or not problem.has_simulator or not ours:
        return None, 0
    states = SobolSampler(problem.dim, seed, torch.float64)

    def draw(count: int, also: Tensor | None = None) -> Samples:
        x = states.draw(count if also is None else count - len(also))
        return Samples.of(problem, x if also is None else torch.cat([also, x]))

    slack = lambda samples, V: Generator.of(problem, samples).hjb_slack(V)
    judged = draw(COMPARISON_STATES)
    unit = float(judged.mean(judged.f))
    worst = lambda own: worst_states(problem, own, states.draw(SCANNED_STATES))
    found = refined(network, slack, draw, steps, ENOUGH_SLACK * unit, stop, worst)
    if found is None or bound(problem, found.network, judged, M) < bound(problem, network, judged, M):
        return None, states.count
    return RefinedValue(found.network.state_dict(), found.residual <= SOLVED_SLACK * unit), states.count


@torch.no_grad()
def worst_states(problem: Problem, value: Field, x: Tensor) -> tuple[Tensor, float]:
    """The ends ``(K, d)`` of ascents from those states of ``x`` ``(N, d)`` with the largest slacks of ``value``, and of
    descents from those with the smallest; and the largest size of the slack there."""
    slack = slack_function(problem, value)
    ends = extremes(slack, x, batched(slack, x), ASCENT_STARTS, ASCENT_STEPS)
    return ends, float(slack(ends).abs().max())


def bound(problem: Problem, network: torch.nn.Module, samples: Samples, M: float) -> float:
    """`F_M` of ``network`` on ``samples``."""
    generator = Generator.of(problem, samples)
    V = generator.chunked_jet(in_float64(network))
    return float(samples.mean(V.value * samples.mu0 - M * generator.hjb_slack(V).clamp_min(0.0)))
