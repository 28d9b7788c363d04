"""The shifted bound of a multiple of `V`, proved over cells that cover the torus (`ocp_torch.certificate.proof`)."""

from typing import TYPE_CHECKING

from ocp_torch.certificate.bound import LOWER, Bound, once
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.context import Context
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.problems.needs import Need

if TYPE_CHECKING:
    from ocp_torch.certificate.proof.rigorous import RigorousBound


class Rigorous(Bound):
    """Only where the settings ask for it, of trained fields in one and two dimensions."""

    name, side, label = "rigorous", LOWER, "rigorous"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return ()

    def applies(self, context: Context) -> bool:
        return context.settings.rigorous and not context.external

    def evaluate(self, context: Context) -> Estimate | None:
        bound, _ = proved(context)
        return bound.estimate if bound else None

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        _, why = proved(context)
        return [f"no rigorous lower bound: {why}."] if why else []

    def searches(self, context: Context) -> list[str]:
        bound, _ = proved(context)
        return [bound.sentence] if bound else []


@once
def proved(context: Context) -> "tuple[RigorousBound | None, str | None]":
    """The proved counterpart of `SampledValue.own`, or why there is none; neither where there is no `V` to speak of."""
    V = context.sampled_value
    if V is None:
        return None, None
    from ocp_torch.certificate.proof.obstacle import obstacle  # loaded only where a proof is asked for
    from ocp_torch.certificate.proof.rigorous import rigorous_lower_bound

    context.progress("proof")
    why = obstacle(context.problem, V.value)
    if why is not None:
        return None, why
    own = V.own
    bound = rigorous_lower_bound(context.problem, V.value, theta=own.theta, sampled_slack=own.largest.value)
    return bound, None if bound else "nothing finite was proved within the budget of cells"
