"""The shifted bound of a certificate."""

from ocp_torch.certificate.bounds.bound import LOWER, Bound, sentence_on
from ocp_torch.certificate.checks.assumptions import Assumptions, found_by_search
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.problems.needs import Need


class Shifted(Bound):
    """The best shifted bound that was found of functions made of `V` (`SampledValue.best`)."""

    name, side, label = "shifted", LOWER, "shifted"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return (found_by_search("sup Q"),)

    def evaluate(self, context: Context) -> Estimate | None:
        return None if context.sampled_value is None else context.sampled_value.best.estimate

    def searches(self, context: Context) -> list[str]:
        if context.sampled_value is None:
            return []
        best = context.sampled_value.best
        return [sentence_on(best.sentence, best.largest)]
