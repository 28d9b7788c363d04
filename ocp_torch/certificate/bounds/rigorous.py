"""The shifted bound of a multiple of `V`, proved over cells that cover the torus (`ocp_torch.certificate.proof`)."""

from typing import TYPE_CHECKING

from ocp_torch.certificate.bounds.bound import LOWER, Bound
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.lower.shifted import Shift
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.problems.needs import GIVEN, Need

if TYPE_CHECKING:  # a proof is loaded only where one is asked for
    from ocp_torch.certificate.proof.rigorous import RigorousBound

ROUNDING = 1e-9  # largest error of a number in float64 by rounding, relative to 1 + its size
REFUTING_LEVEL = 0.9999  # level of the interval of a sampled mean that, outside the proved one, refutes a proof


class Rigorous(Bound):
    """The proved bound, only where the settings ask for it, of trained fields in one and two dimensions."""

    name, side, label = "rigorous", LOWER, "rigorous"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return (assumptions.data_are_enclosed,) if assumptions.basis.get("data") == GIVEN else ()

    def applies(self, context: Context) -> bool:
        return context.settings.rigorous and not context.external

    def evaluate(self, context: Context) -> Estimate | None:
        return proved(context)[0]

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        return proved(context)[1]

    def searches(self, context: Context) -> list[str]:
        return proved(context)[2]


def proved(context: Context) -> tuple[Estimate | None, list[str], list[str]]:
    """The proved counterpart of `SampledValue.own` or `None`, a note that says why, and what was proved in words."""
    if "proved" not in context.results:
        context.results["proved"] = _proved(context)
    return context.results["proved"]


def _proved(context: Context) -> tuple[Estimate | None, list[str], list[str]]:
    V = context.sampled_value
    if V is None:
        return None, [], []
    from ocp_torch.certificate.proof.rigorous import obstacle, rigorous_lower_bound  # only where it is asked for

    context.progress("proof")
    why, own = obstacle(context.problem, V.value, context.narrow_states), V.own
    if why is not None:
        return None, [f"no rigorous lower bound: {why}."], []
    bound = rigorous_lower_bound(context.problem, V.value, theta=own.theta, sampled_slack=own.largest.value)
    if bound is None:
        return None, ["no rigorous lower bound: nothing finite was proved within the budget of cells."], []
    if (wrong := refuted(own, bound)) is not None:
        told = f"no rigorous lower bound: {wrong}; the problem's enclosure or Lipschitz constants are wrong."
        return None, [told], []
    return Estimate(bound.value, 0.0), [], [bound.sentence]  # nothing in it is random


def refuted(own: "Shift", bound: "RigorousBound") -> str | None:
    """How ``own``, the same bound by sampling, contradicts what ``bound`` proves of the problem, in words; `None` if it does
    not."""
    met, mean = own.largest.value, Estimate.of([own.theta * mean for mean in own.initial])
    if met > bound.slack + ROUNDING * (1.0 + abs(met)):
        return f"sup Q <= {bound.slack:.4g} would be proved, but {met:.4g} was met"
    (low, high), (least, most) = mean.interval(REFUTING_LEVEL), bound.integral
    room = ROUNDING * (1.0 + abs(mean.value))
    if low > most + room or high < least - room:
        sampled = f"{mean.value:.6g} +- {0.5 * (high - low):.2g}"
        return f"E[W mu0] would be in [{least:.6g}, {most:.6g}], but sampling says {sampled}"
    return None
