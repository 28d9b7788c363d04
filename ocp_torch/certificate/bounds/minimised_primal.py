r"""`G(w) = min_mu J(w, mu)`, pointwise and in closed form where there is no drift (Lemma 2 of the paper)."""

from ocp_torch.certificate.bounds.bound import UPPER, Bound
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.contexts.context import Context
from ocp_torch.certificate.settings import CERTIFIED
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.control.policies import CLOSED, DENSITY, MINIMISED
from ocp_torch.problems.needs import Need


class MinimisedPrimal(Bound):
    """`G` of a trained `w`."""

    name, side, label = "G", UPPER, "G"

    def needs(self, assumptions: Assumptions) -> tuple[Need, ...]:
        return assumptions.C_V_is_large, assumptions.cost_is_positive

    def evaluate(self, context: Context) -> Estimate | None:
        return context.densities.G if context.densities else None

    def valid(self, context: Context) -> bool:
        """`G` takes the divergence of `B w`: `w` is smooth, so that only jumps of the problem make it wrong."""
        jump = context.observed.jump
        jumps = jump is not None and jump.in_problem
        return context.hidden is None and not jumps and context.well_posed.smooth_seam

    def about(self, context: Context) -> str | None:
        """`w` over the `mu` of Lemma 2, whose performance `G` bounds where none of its simulated values exceeds `C_V`."""
        name = DENSITY if context.occupation == CLOSED else MINIMISED
        return name if name in context.candidates and context.value_holds_of(name) else None

    def notes(self, context: Context, shown: Estimate | None) -> list[str]:
        about = self.about(context)
        if shown is None or about == context.kind or about and context.settings.prefer == CERTIFIED:
            return []
        return ["G bounds OPT, but not the controller that is handed out: the gap does not use it."]
