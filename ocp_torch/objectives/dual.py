r"""The dual with an exact penalty, D(M) (section 4.1 of the paper), and the bound without `M` where no `M` is known."""

from torch import Tensor

from ocp_torch.errors import require_number
from ocp_torch.fields.fields import VALUE, Fields
from ocp_torch.objectives.objective import Objective, Phase
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples


class Dual(Objective):
    r"""Maximise `F_M(V) = E[V mu0 - M max(Q, 0)]`: at most `OPT` for every `V` once `M >= sup mu*` (Proposition 3).

    With ``residual`` `k > 0` also `-(k/s) E[Q^2]`, `s` the scale of the `V` network. `V*` is optimal for that too, since
    `Q = 0` almost everywhere there; unlike the hinge it has a gradient on both sides of the solution. The paper's dual is
    ``residual = 0``.

    Where no `M` is known to be large enough (`Constants.unbounded`) what is certified is `E[V mu0] - sup Q`. A large
    `M` keeps the supremum small; but from the start it ends in subsolutions far below `V*`, which have no gradient. So `M`
    grows along a round: first `V` is too high, and then comes down until it is feasible. That leaves it below `V*` nearly
    everywhere, as hinges and noise of steps push it down only. So from the second round on, when `V` is close, the squared
    slack weighs more; from the start it would lead to functions that solve the equation almost everywhere and are not `V*`.
    """

    players = {"value": (VALUE,)}

    def __init__(self, problem: Problem, residual: float = 0.3) -> None:
        super().__init__(problem)
        self.residual = require_number("method.residual", residual, at_least=0.0)

    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        generator = self.generator(samples)
        V = generator.jet(fields.value)
        slack = generator.hjb_slack(V)
        return {"value": value_loss(phase, fields, samples, V.value, slack, self.residual)}


def value_loss(phase: Phase, fields: Fields, samples: Samples, value: Tensor, slack: Tensor, residual: float) -> Tensor:
    """The loss of a value player alone: `E[M max(Q, 0) + (residual / s) Q^2 - V mu0]`, the first two weighed by ``phase``."""
    violation = phase.growth * phase.constants.M * slack.clamp_min(0.0)
    if residual > 0.0:
        violation = violation + phase.residual_growth * residual / getattr(fields.value, "scale", 1.0) * slack.square()
    return samples.penalty(violation) - samples.mean(value * samples.mu0)
