r"""The primal with an exact penalty, P-P (section 5 of the paper)."""

from torch import Tensor

from ocp_torch.errors import InputError, require_choice
from ocp_torch.fields.fields import CONTROL_DENSITY, LOG_OCCUPATION, Fields
from ocp_torch.objectives.objective import CLOSED, NETWORK, Objective, Phase
from ocp_torch.objectives.saddle import Saddle
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


class ClosedPrimal(Objective):
    r"""Without drift: minimise `G(w) = min_mu J(w, mu)`, whose minimum over `mu` is pointwise (Lemma 2)."""

    players = {"density": (CONTROL_DENSITY,)}
    occupation = CLOSED

    def needs_divergences(self, phase: Phase) -> bool:
        return True

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        w, inflow = self.generator(samples).control_inflow(fields.control_density)
        return {"density": samples.mean(self.cost.primal_minimum(w, samples.f, phase.constants.C_V, inflow))}


class NetworkPrimal(Objective):
    r"""With drift: minimise `J(w, mu)` over two networks, `w` and `log mu`."""

    players = {"density": (CONTROL_DENSITY, LOG_OCCUPATION)}
    occupation = NETWORK

    def needs_divergences(self, phase: Phase) -> bool:
        return True

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        generator = self.generator(samples)
        w, inflow = generator.control_inflow(self.admissible(fields))
        mu, outflow = generator.occupation_outflow(fields.log_occupation)
        return {"density": samples.mean(generator.primal_integrand(w, mu, inflow - outflow, phase.constants.C_V))}


def primal(problem: Problem, occupation: str = "auto") -> Objective:
    """The primal with `mu` in closed form (only where `a = 0`), by a network, or whichever suits the problem.

    Raises `InputError` for ``occupation="closed"`` with drift.
    """
    require_choice("method.occupation", occupation, ("auto", "closed", "network"))
    if occupation == "closed" and not problem.driftless:
        raise InputError(
            "method.occupation is 'closed', but this problem has drift, for which mu has no closed form; "
            "use method.occupation=network or auto."
        )
    if occupation == "closed" and not problem.has_simulator:
        raise InputError("method.occupation is 'closed', but mu at a new state needs f there, which no data set gives.")
    if not problem.gives_divergences:
        note = "this problem gives no divergences of a and B: primal falls back to the saddle, without J."
        return Saddle(problem, augmentation=1.0, notes=(note,))
    closed = problem.driftless and problem.has_simulator and occupation != "network"
    return (ClosedPrimal if closed else NetworkPrimal)(problem)
