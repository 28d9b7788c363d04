"""The inner loop that every fit shares: draw, step, average."""

from __future__ import annotations

from collections.abc import Callable

from ocp_torch.fields.fields import Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.objectives.phase import Phase
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.averaging import Average, averaged
from ocp_torch.steppers.optimizers import optimizer_maker, schedule_maker
from ocp_torch.steppers.simultaneous import Simultaneous
from ocp_torch.steppers.stepper import Stepper, StepReport


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
