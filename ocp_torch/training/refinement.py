"""What ends a round of training: Gauss-Newton steps by which `V` solves the Hamilton-Jacobi-Bellman equation."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from ocp_torch.certificate.trained import in_float64
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.gauss_newton import refined
from ocp_torch.training.observer import Silent

if TYPE_CHECKING:
    from ocp_torch.training.trainer import Trainer

# States on which `F_M` is compared: the same for both, so that it differs by what the steps do.
JUDGED = 8192


def refine(trainer: "Trainer", monitor: Silent, stop: Callable[[], bool]) -> None:
    """Refine the averaged `V` of ``trainer``, from which the next round starts, if that helps; to be done anew where it was
    told to ``stop``."""
    state, limit, started, told = trainer.state, trainer.settings.max_seconds, time.perf_counter(), []
    spent = lambda: time.perf_counter() - started

    def stopping() -> bool:
        if stop() or (limit is not None and state.elapsed + spent() >= limit):
            told.append(True)  # what comes after the last step is late: then they are done
        return bool(told)

    seed = derive_seed(trainer.seed, Branch.REFINEMENT, state.round)
    how = trainer.constants.M, trainer.settings.newton_steps, seed, stopping
    monitor.refined(trainer, None)
    weights = trainer.ranks.from_first(lambda: refined_value(trainer.problem, trainer.averaged_fields, *how))
    if weights is not None:
        for fields in (trainer.fields, trainer.averaged_fields):
            fields.value.load_state_dict(weights)
        trainer.evaluator.latest = None  # it is of the `V` before
    monitor.refined(trainer, weights is not None)
    state.refined = trainer.ranks.from_first(lambda: not told)
    state.elapsed += spent()


def refined_value(
    problem: Problem, fields: Fields, M: float, steps: int, seed: int, stop: Callable[[], bool]
) -> dict | None:
    """The weights of the `V` of ``fields`` after so many ``steps`` on its slack at evenly spread states of ``seed``; `None`
    where they do not help, as beside kinks or with noise, or make `F_M` worse, and where told to ``stop``."""
    network = fields.value
    ours = isinstance(network, PeriodicMLP) and network.can_be_swept
    if not steps or problem.noisy or not problem.has_simulator or not ours:
        return None
    states = SobolSampler(problem.dim, seed, torch.float64)
    draw = lambda count: Samples.of(problem, states.draw(count))
    slack = lambda samples, V: Generator.of(problem, samples).hjb_slack(V)
    found = refined(network, slack, draw, steps, stop)
    if found is None:
        return None
    judged = draw(JUDGED)
    worse = bound(problem, found, judged, M) < bound(problem, network, judged, M)
    return None if worse else found.state_dict()


def bound(problem: Problem, network: torch.nn.Module, samples: Samples, M: float) -> float:
    """`F_M` of ``network`` on ``samples``."""
    generator = Generator.of(problem, samples)
    V = generator.chunked_jet(in_float64(network))
    return float(samples.mean(V.value * samples.mu0 - M * generator.hjb_slack(V).clamp_min(0.0)))
