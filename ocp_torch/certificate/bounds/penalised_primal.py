"""`J` as a bound of a certificate."""

from ocp_torch.certificate.bounds.bound import UPPER, Bound, recorded
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.control.policies import DENSITY
from ocp_torch.problems.needs import Need


class PenalisedPrimal(Bound):
    """The lower of two `J`: that of the trained `w` and `mu`, and that of the density fitted to the closed loop."""

    name, side, label = "J", UPPER, "J"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return assumptions.C_V_is_large, assumptions.cost_is_positive, assumptions.regular

    def applies(self, context: Context) -> bool:
        return not context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        if context.closed_loop and context.shows_fitted_J:
            return None if context.coarse else context.closed_loop.J
        return context.densities.J if context.densities else None

    def valid(self, context: Context) -> bool:
        return context.hidden is None

    def about(self, context: Context) -> str | None:
        """The controller whose closed loop was fitted if that `J` is shown, or `w / mu` if that is the one followed."""
        return context.followed if context.shows_fitted_J or context.followed == DENSITY else None

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        notes = []
        if context.hidden is not None:
            notes.append(f"{context.divergent} are not used: {context.hidden.sentence}.")
        if context.fitted is not None and context.coarse:
            notes.append("J is left out: the controller computes in float32, too coarse for its divergence.")
        found = context.closed_loop if context.shows_fitted_J and context.densities else None
        if found is not None and not context.checked.value_holds:
            notes.append(f"the J shown is that of the closed loop, with C_V = {found.C_V:.4g} proved for it.")
        return notes


class RecordedPrimal(PenalisedPrimal):
    """`J` where only recorded samples are known."""

    def applies(self, context: Context) -> bool:
        return context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        fit = recorded(context).fit
        return fit.J if fit else None

    def valid(self, context: Context) -> bool:
        return context.hidden is None and context.checked.regular_holds

    def about(self, context: Context) -> str | None:
        return context.kind

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        if context.hidden is not None:
            return [f"J is not used: {context.hidden.sentence}."]
        fit = recorded(context).fit
        said = "J is above the controller's performance if C_V = {:.4g}, by the samples met, bounds its value."
        return [said.format(fit.C_V)] if fit else []
