"""Simultaneous gradient steps: every player moves at once, from the same point and the same samples."""

from __future__ import annotations

from ocp_torch.steppers.stepper import Draw, Stepper, StepReport, Visit


class Simultaneous(Stepper):
    """The iterate before the update is the one that counts, as in the paper's average `(1/n) sum_{k<n} theta_k`."""

    def step(self, draw: Draw, visit: Visit) -> StepReport:
        samples = draw()
        losses, norms = self._differentiate(samples)
        visit()
        self._update(losses)
        self._advance_schedules(losses)
        return StepReport(losses, norms, samples, len(samples))
