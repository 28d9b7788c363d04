"""Simultaneous gradient steps: every player moves at once, from the same point and the same samples."""

from collections.abc import Sequence

from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.stepper import Stepper, StepReport


class Simultaneous(Stepper):
    """The iterate before the update is the one that counts, as in the paper's average `(1/n) sum_{k<n} theta_k`."""

    def step(self, batches: Sequence[Samples], phase: Phase) -> StepReport:
        (samples,) = batches
        losses, norms = self._differentiate(samples, phase)
        counted = self._parameters()
        self._update(losses)
        return StepReport(losses, norms, batches, counted)
