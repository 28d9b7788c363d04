"""Extragradient (stochastic mirror-prox, equations 18 and 19 of the paper) around any optimiser."""

from collections.abc import Sequence

import torch

from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.stepper import Stepper, StepReport


class Extragradient(Stepper):
    """Look ahead, differentiate there on independent samples, and apply that gradient from where the step began.

    With SGD this is the paper's iteration; a stateful optimiser updates its moments at both points. The look-ahead
    point is the iterate that counts.
    """

    draws = 2

    def step(self, batches: Sequence[Samples], phase: Phase) -> StepReport:
        first, second = batches
        origin = self._parameters()
        players, _ = self._differentiate(first, phase)
        self._update(players, ahead=True)
        counted = self._parameters()
        try:
            losses, norms = self._differentiate(second, phase)
        finally:
            # Also when the look-ahead point turns out bad: a failed step leaves the parameters where it began.
            with torch.no_grad():
                torch._foreach_copy_(list(self.fields.parameters()), origin)
        self._update(losses)
        return StepReport(losses, norms, batches, counted)
