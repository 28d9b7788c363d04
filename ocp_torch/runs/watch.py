"""Runs started from Python: their scalars are kept, and passed to a callback that may stop the run."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from ocp_torch.certificate import Certificate
from ocp_torch.runs.trained import History
from ocp_torch.steppers import StepReport
from ocp_torch.training.monitor import Monitor, record
from ocp_torch.training.trainer import Trainer

# Kinds of a `Moment`.
STEP = "step"
LOOK = "look"
WARM_START = "warm start"


@dataclass(frozen=True)
class Moment:
    """The argument of a callback.

    ``kind`` is `step` (one of every `trainer.log_every`), `look` (a quick evaluation, every `trainer.evaluate_every`) or
    `warm start` (a try of its controller). ``step`` counts training steps, or the rounds of a warm start. ``scalars`` are
    named as in TensorBoard (`loss/value`, `bounds/F_M`, `gap/certified`), in the units of the problem's cost. A look has a
    ``certificate`` from few samples, a dict as in `certificate.json`; elsewhere it is `None`.
    """

    kind: str
    step: int
    scalars: dict[str, float]
    certificate: dict | None = None


# Returns `True` to stop the run after the step in hand, with a certificate.
Callback = Callable[[Moment], object]


class CallbackFailed(BaseException):
    """A callback raised its ``__cause__``. Not an `Exception`, so that no handler takes it for a failure of the problem."""


class Scalars:
    """Passes scalars on to TensorBoard's ``writer``, where there is one, and keeps a copy."""

    def __init__(self, writer: SummaryWriter | None = None) -> None:
        self._writer, self._new = writer, dict[str, float]()

    def add_scalar(self, name: str, value: Any, step: int) -> None:
        self._new[name] = float(value)
        if self._writer is not None:
            self._writer.add_scalar(name, value, step)

    def take(self) -> dict[str, float]:
        """The scalars added since the last call."""
        new, self._new = self._new, {}
        return new

    def __getattr__(self, name: str) -> Any:
        return getattr(self._writer, name)


class Watch(Monitor):
    """A monitor that also fills a ``history`` and tells a ``callback``."""

    def __init__(self, folder: Path, trainer: Trainer, history: History, callback: Callback | None = None) -> None:
        super().__init__(folder, trainer)
        self._scalars = Scalars(self.writer)
        self.writer = cast(SummaryWriter, self._scalars)
        self._history, self._callback, self._trainer = history, callback, trainer

    def stepped(self, trainer: Trainer, report: StepReport, log: bool) -> None:
        super().stepped(trainer, report, log)
        if log:
            self._tell(self._history.steps, Moment(STEP, trainer.step, self._scalars.take()))

    def evaluated(self, trainer: Trainer, certificate: Certificate) -> None:
        super().evaluated(trainer, certificate)
        self._tell(self._history.looks, Moment(LOOK, trainer.step, self._scalars.take(), certificate.to_dict()))

    def warmed(self, trainer: Trainer, looked: bool) -> None:
        super().warmed(trainer, looked)
        warm, scalars = trainer.state.warm, self._scalars.take()
        if looked and warm is not None:
            self._tell(self._history.warm_start, Moment(WARM_START, warm.round, scalars))

    def finish(self, certificate: Certificate, figures: dict, settings: dict, step: int) -> None:
        super().finish(certificate, figures, settings, step)
        last = Scalars()
        record(cast(SummaryWriter, last), certificate, step)
        self._keep(self._history.looks, step, last.take())

    def _tell(self, rows: list[dict], moment: Moment) -> None:
        self._keep(rows, moment.step, moment.scalars)
        if self._callback is None:
            return
        try:
            answer = self._callback(moment)
        except Exception as error:  # whatever a user's code may raise
            raise CallbackFailed from error
        # Only `True` stops the run: a callback that draws or appends may return something else.
        self._trainer.asked |= isinstance(answer, bool | np.bool_) and bool(answer)

    def _keep(self, rows: list[dict], step: int, scalars: dict[str, float]) -> None:
        state = self._trainer.state
        rows.append({"step": step, "samples": state.samples, "seconds": state.seconds, **scalars})
