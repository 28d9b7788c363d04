"""A step that is made whole or not at all, whatever becomes of the other processes of the run."""

import copy
from collections.abc import Sequence
from typing import Any

from ocp_torch.compute.processes import LostError, SingleProcess
from ocp_torch.objectives import Phase
from ocp_torch.steppers import StepReport, advance
from ocp_torch.training.state import TrainState


def whole_step(state: TrainState, phase: Phase, ranks: SingleProcess) -> StepReport:
    """Make a step of ``state`` at ``phase``. Where others of ``ranks`` are lost in the middle of it, all that it moved is put
    back, and `LostError` raised. Raises `NonFiniteError` as `Stepper.step` does."""
    moved: Sequence[Any] = (state.batches,) if ranks.size > 1 else ()
    if moved and state.stepper.draws > 1:  # one of a single batch moves no weights before it has heard of all others
        moved = (state.batches, state.stepper, state.fields)
    before = [copy.deepcopy(part.state_dict()) for part in moved]
    try:
        return advance(state.stepper, state.average, state.batches.draw, phase)
    except LostError:
        for part, was in zip(moved, before, strict=True):
            part.load_state_dict(was)
        raise
