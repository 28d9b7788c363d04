"""The Lagrangian bound of a certificate."""

from ocp_torch.certificate.bounds.bound import PERFORMANCE, UPPER, Bound, sentence_on
from ocp_torch.certificate.checks.assumptions import Assumptions, found_by_search
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.certificate.upper.lagrangian import ClosedLoopBounds
from ocp_torch.problems.needs import Need


class Lagrangian(Bound):
    """The Lagrangian bound of the controller that is followed, from the density that was fitted to its closed loop."""

    name, side, label = "lagrangian", UPPER, "Lagrangian"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return found_by_search("sup |Q_u|"), assumptions.regular

    def evaluate(self, context: Context) -> Estimate | None:
        return context.closed_loop.lagrangian if context.closed_loop else None

    def about(self, context: Context) -> str | None:
        return context.followed

    def searches(self, context: Context) -> list[str]:
        return slack_searches(context.closed_loop)


class LagrangianBelow(Lagrangian):
    """The Lagrangian bound with its signs reversed: a lower bound on the performance of a given controller."""

    side = PERFORMANCE

    def applies(self, context: Context) -> bool:
        return context.external

    def evaluate(self, context: Context) -> Estimate | None:
        return context.closed_loop.below if context.closed_loop else None


def slack_searches(found: ClosedLoopBounds | None) -> list[str]:
    """How the two suprema of the slack behind ``found`` were found, a sentence each."""
    if found is None:
        return []
    named = lambda what: f"{what} of {found.how}"
    return [sentence_on(named("eps_hi"), found.eps_hi), sentence_on(named("eps_lo"), found.eps_lo)]
