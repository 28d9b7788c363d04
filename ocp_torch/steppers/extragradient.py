"""Extragradient (stochastic mirror-prox, equations 18 and 19 of the paper) around any optimiser."""

from __future__ import annotations

import torch

from ocp_torch.steppers.stepper import Draw, Stepper, StepReport, Visit


class Extragradient(Stepper):
    """Look ahead, differentiate there on independent samples, and apply that gradient from where the step began.

    With SGD this is the paper's iteration; a stateful optimiser updates its moments at both points. The look-ahead
    point is the iterate that counts.
    """

    def step(self, draw: Draw, visit: Visit) -> StepReport:
        everything = [p for parameters in self.parameters.values() for p in parameters]
        origin = [p.detach().clone() for p in everything]
        first = draw()
        ahead, _ = self._differentiate(first)
        self._update(ahead)
        visit()
        second = draw()
        try:
            losses, norms = self._differentiate(second)
        finally:
            # Also when the look-ahead point turns out bad: a failed step leaves the parameters where it began.
            with torch.no_grad():
                torch._foreach_copy_(everything, origin)
        self._update(losses)
        self._advance_schedules(losses)
        return StepReport(losses, norms, second, len(first) + len(second))
