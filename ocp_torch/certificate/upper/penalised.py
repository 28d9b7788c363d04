r"""`J(w, mu) = E[(f + R(w/mu)) mu + C_V max(r, 0)]`, with `r` the Liouville residual of `w` and `mu` (Proposition 6)."""

from ocp_torch.certificate.bound import UPPER, Bound
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.context import Context
from ocp_torch.certificate.estimate import Estimate
from ocp_torch.problems.needs import Need


class PenalisedPrimal(Bound):
    """The lower `J` of two: that of the trained `w` and `mu`, and that of the density fitted to the closed loop."""

    name, side, label = "J", UPPER, "J"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return assumptions.C_V_is_large, assumptions.cost_is_positive, assumptions.regular

    def applies(self, context: Context) -> bool:
        return not context.recorded

    def evaluate(self, context: Context) -> Estimate | None:
        if context.closed_loop and context.takes_fitted_J:
            return None if context.coarse else context.closed_loop.J
        return context.densities.J if context.densities else None

    def valid(self, context: Context) -> bool:
        return context.hidden is None

    def speaks(self, context: Context) -> bool:
        """`J` bounds the performance of `w / mu`, or of the controller whose closed loop was fitted; of nothing else."""
        return context.takes_fitted_J or context.kind == "density"

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        notes = []
        if context.hidden is not None:
            notes.append(f"{context.divergent} are not used: {context.hidden.sentence}.")
        if context.fitted is not None and context.coarse:
            notes.append("J is left out: the controller computes in float32, too coarse for its divergence.")
        found = context.closed_loop if context.takes_fitted_J and context.densities else None
        if found is not None and not context.checked.value_holds:
            notes.append(f"the J shown is that of the closed loop, with C_V = {found.C_V:.4g} proved for it.")
        return notes
