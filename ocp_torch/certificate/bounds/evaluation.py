"""What the Bellman slack of any `V` says of a given controller's performance, without divergences (1. in `lagrangian`)."""

from ocp_torch.certificate.bounds.bound import PERFORMANCE, UPPER, Bound
from ocp_torch.certificate.bounds.lagrangian import slack_searches
from ocp_torch.certificate.checks.assumptions import Assumptions, found_by_search
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.problems.needs import Need


class Evaluation(Bound):
    """`Perf(u) <= E[V mu0] + eps_hi`, also of a controller that jumps."""

    name, side, label = "evaluation", UPPER, "evaluation"
    end = 1  # the upper end of `ClosedLoopBounds.sandwich`

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return (found_by_search("sup |Q_u|"),)

    def applies(self, context: Context) -> bool:
        return context.external

    def evaluate(self, context: Context) -> Estimate | None:
        return context.fitted.sandwich[self.end] if context.fitted else None

    def searches(self, context: Context) -> list[str]:
        return slack_searches(context.fitted)


class EvaluationBelow(Evaluation):
    """`E[V mu0] - eps_lo <= Perf(u)`."""

    side, end = PERFORMANCE, 0
