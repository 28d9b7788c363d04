"""The certification stage: fit `mu` (and `V`, where there is none) to the closed loop of the controller handed out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from ocp_torch.bounds import Bounds
from ocp_torch.control_laws import ControlLaw
from ocp_torch.errors import require_integer, require_number
from ocp_torch.fields.fields import LOG_OCCUPATION, VALUE, Fields
from ocp_torch.objectives.policy_evaluation import PolicyEvaluation
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.problem import Problem
from ocp_torch.samplers import UniformSampler, derive_seed
from ocp_torch.samples import Samples
from ocp_torch.steppers import Simultaneous, averaged, optimizer_maker, schedule_maker

# Branch of the seed tree for the stage's states and weights, beside those of training and evaluation.
STAGE_STREAM = 3
# The closed loop's data are computed once on so many states at most: their divergences cost more than a step.
POOL = 2**16


@dataclass(frozen=True)
class StageSettings:
    """Budget of the certification stage. Raises `InputError` on a wrong value."""

    steps: int = 2000  # least-squares steps; 0 for no stage
    batch: int = 512  # states per step
    lr: float = 3.0e-3  # learning rate, with cosine decay

    def __post_init__(self) -> None:
        require_integer("certificate.stage.steps", self.steps, 0)
        require_integer("certificate.stage.batch", self.batch, 1)
        require_number("certificate.stage.lr", self.lr, above=0.0)


def fit_closed_loop(
    problem: Problem,
    law: ControlLaw,
    fields: Fields | None,
    network: Callable[..., torch.nn.Module],
    bounds: Bounds,
    settings: StageSettings,
    seed: int,
) -> Fields:
    """Fields with `log mu^u`, and with `V^u` where ``fields`` hold no `V`, of the closed loop of ``law``.

    ``fields`` are the trained ones, ``law`` one of theirs in their precision; their `log mu`, if any, is the start. With no
    ``fields`` the law is somebody's own, in float64, and both `mu` and `V` are fitted in float32.
    """
    like = torch.zeros(()) if fields is None else next(fields.parameters())
    loop = ClosedLoop(problem, law)
    with_value = fields is None or fields.value is None
    objective = PolicyEvaluation(loop, bounds, with_value)
    names = (LOG_OCCUPATION, VALUE) if with_value else (LOG_OCCUPATION,)
    fitted = Fields.build(problem, names, network, derive_seed(seed, STAGE_STREAM, 0)).to(like)
    if fields is not None and fields.log_occupation is not None:
        fitted.log_occupation.load_state_dict(fields.log_occupation.state_dict())
    pool = _pool(
        loop, min(POOL, settings.steps * settings.batch), derive_seed(seed, STAGE_STREAM, 1), like, fields is None
    )
    picker = torch.Generator().manual_seed(derive_seed(seed, STAGE_STREAM, 2))
    draw = lambda: pool.take(torch.randint(len(pool), (settings.batch,), generator=picker).to(like.device))
    optimizer = optimizer_maker("soap", settings.lr, betas=(0.95, 0.95))
    makers = {player: optimizer for player in objective.players}
    stepper = Simultaneous(fitted, objective, makers, schedule_maker("cosine", settings.steps))
    average = averaged(fitted, decay=0.98)
    for _ in range(settings.steps):
        stepper.step(draw, lambda: average.update_parameters(fitted))
    return average.module


def _pool(loop: ClosedLoop, count: int, seed: int, like: torch.Tensor, double: bool) -> Samples:
    """States and the closed loop's data there, evaluated in float64 if ``double``, kept in the precision of ``like``."""
    x = UniformSampler(loop.dim, seed, torch.float64 if double else like.dtype).draw(count).to(like.device)
    return Samples.concatenate([Samples.of(loop, part) for part in x.split(4096)]).to(like)
