"""The inner loop that every fit shares: draw, step, average. Averages are those of `torch.optim.swa_utils`."""

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn, get_swa_multi_avg_fn

from ocp_torch.errors import require_choice, require_number
from ocp_torch.fields.fields import Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.objectives.phase import Phase
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.optimizers import optimizer_maker, schedule_maker
from ocp_torch.steppers.simultaneous import Simultaneous
from ocp_torch.steppers.stepper import Stepper, StepReport

# A memory of about 1 / (1 - decay) = 50 steps: a longer one lags behind the last steps of the cosine schedule.
DECAY = 0.98
# At 1 the average would never leave the first iterate.
MOST_DECAY = 0.999999


class Average(AveragedModel):
    """The average of the iterates that were counted is in ``module``."""

    module: Fields

    def count(self, iterate: Sequence[Tensor]) -> None:
        """Take ``iterate``, all parameters in the order of those of the fields, into the average."""
        alike: Any = SimpleNamespace(parameters=lambda: iterate, buffers=self.module.buffers)
        self.update_parameters(alike)


def averaged(fields: Fields, kind: str = "ema", decay: float = DECAY) -> Average:
    """A running average of ``fields``: ``ema`` (exponential with ``decay``), ``uniform`` as in the paper, or ``none``.

    Raises `InputError` for another ``kind``, or a ``decay`` outside of [0, 0.999999].
    """
    require_choice("averaging.kind", kind, ("ema", "uniform", "none"))
    decay = require_number("averaging.decay", decay, at_least=0.0, at_most=MOST_DECAY)
    rules = {"ema": lambda: get_ema_multi_avg_fn(decay), "uniform": get_swa_multi_avg_fn, "none": lambda: _latest}
    return Average(fields, multi_avg_fn=rules[kind](), use_buffers=False).requires_grad_(False)


def _latest(averages: list, currents: list, count) -> None:
    for average, current in zip(averages, currents, strict=True):
        average.copy_(current)


def advance(stepper: Stepper, average: Average, draw: Callable[[Phase], Samples], phase: Phase) -> StepReport:
    """One step at ``phase`` on as many batches of ``draw`` as the stepper takes; its iterate is counted in ``average``.

    Raises `NonFiniteError` as `Stepper.step` does; nothing is counted then.
    """
    report = stepper.step([draw(phase) for _ in range(stepper.draws)], phase)
    average.count(report.counted)
    return report


def short_fit(
    fields: Fields, objective: Objective, lr: float, steps: int, unit: float = 1.0
) -> tuple[Simultaneous, Average]:
    """Stepper and average of a fit that nobody configures: SOAP, a learning rate that falls from ``lr`` to 0 in ``steps``.

    ``unit`` is what losses are divided by (see `cost_unit`).
    """
    makers = {player: optimizer_maker("soap", lr) for player in objective.players}
    stepper = Simultaneous(fields, objective, makers, schedule_maker("cosine", steps), unit=unit)
    return stepper, averaged(fields)
