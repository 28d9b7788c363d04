"""`F_M` from recorded samples: an expectation over the torus of what was recorded, so a weighted mean of held-out samples."""

from __future__ import annotations

from ocp_torch.certificate.bound import recorded
from ocp_torch.certificate.context import Context
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.certificate.lower.penalised import PenalisedDual
from ocp_torch.maths.jets import Field, chunked_jet
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


class RecordedDual(PenalisedDual):
    """`F_M` where only recorded samples are known."""

    def applies(self, context: Context) -> bool:
        return context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        if context.value is None:
            return None
        return penalised(context.problem, context.value, context.constants.M, recorded(context).sets)


def penalised(problem: Problem, value: Field, M: float, sets: list[Samples]) -> Estimate:
    """`F_M(V) = E[V mu0 - M max(Q, 0)]`, from independent ``sets`` of samples."""
    values = []
    for samples in sets:
        V = chunked_jet(value, samples.x)
        slack = Generator.of(problem, samples).hjb_slack(V)
        values.append(integral(samples, V.value * samples.mu0 - M * slack.clamp_min(0.0)))
    return Estimate.of(values)
