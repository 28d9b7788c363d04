"""`F_M` as a bound of a certificate."""

from ocp_torch.certificate.bounds.bound import LOWER, Bound, recorded
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.lower.penalised import levelled, penalised, penalised_on_records
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.problems.needs import Need


class PenalisedDual(Bound):
    """`F_M` of a `V` that is known everywhere."""

    name, side, label = "F_M", LOWER, "F_M"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return (assumptions.M_is_large,)

    def applies(self, context: Context) -> bool:
        return not context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        V, constants = context.sampled_value, context.effective_constants
        if V is None:
            return None
        # Training aimed at the bound without M, to which the constant in V means nothing.
        return levelled(V.best, constants.M) if constants.needs_no_M else penalised(V, constants.M)


class RecordedDual(PenalisedDual):
    """`F_M` where only recorded samples are known: a weighted mean over the held-out samples."""

    def applies(self, context: Context) -> bool:
        return context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        if context.value is None:
            return None
        problem, sets = recorded(context).problem, recorded(context).sets
        return penalised_on_records(problem, sets, context.value, context.effective_constants.M)
