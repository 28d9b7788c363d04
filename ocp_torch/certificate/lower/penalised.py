r"""`F_M(V) = E[V mu0 - M max(Q, 0)] <= OPT` for every `M >= sup mu*` (section 4.1 of the paper)."""

from dataclasses import replace

import torch

from ocp_torch.certificate.bound import LOWER, Bound, recorded
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.checks.tails import rarity
from ocp_torch.certificate.context import Context
from ocp_torch.certificate.estimate import Estimate, integral
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.needs import Need


class PenalisedDual(Bound):
    """`F_M` of a `V` that is known everywhere."""

    name, side, label = "F_M", LOWER, "F_M"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return (assumptions.M_is_large,)

    def applies(self, context: Context) -> bool:
        return not context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        V = context.sampled_value
        return None if V is None else penalised(V, context.informed.M)


class RecordedDual(PenalisedDual):
    """`F_M` where only recorded samples are known: a weighted mean of those that were held out."""

    def applies(self, context: Context) -> bool:
        return context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        if context.value is None:
            return None
        values = []
        for samples in recorded(context).sets:
            generator = Generator.of(context.problem, samples)
            V = generator.chunked_jet(context.value)
            slack = generator.hjb_slack(V)
            values.append(integral(samples, V.value * samples.mu0 - context.informed.M * slack.clamp_min(0.0)))
        return Estimate.of(values)


def penalised(V: SampledValue, M: float) -> Estimate:
    """`F_M`, its interval widened where a few states carry `E[max(Q, 0)]`."""
    pairs = zip(V.sets, V.own.parts, strict=True)
    violations = [samples.weight * part.slack(1.0).clamp_min(0.0) for samples, part in pairs]
    found = Estimate.of([e - M * float(v.mean()) for e, v in zip(V.initial, violations, strict=True)])
    rare = rarity(torch.cat(violations), sum(V.initial) / len(V.initial) / M)
    return replace(found, bias=M * rare) if rare > 0.0 else found
