"""The bounds of a certificate, listed once: gaps, tables, files and the benchmark's columns follow from this list."""

from ocp_torch.certificate.bound import Bound
from ocp_torch.certificate.lower.penalised import PenalisedDual, RecordedDual
from ocp_torch.certificate.lower.rigorous import Rigorous
from ocp_torch.certificate.lower.shifted import Shifted
from ocp_torch.certificate.upper.evaluation import Evaluation, EvaluationBelow
from ocp_torch.certificate.upper.lagrangian import Lagrangian, LagrangianBelow
from ocp_torch.certificate.upper.minimised import MinimisedPrimal
from ocp_torch.certificate.upper.penalised import PenalisedPrimal
from ocp_torch.certificate.upper.recorded import RecordedPrimal

# In the order of `certificate.json`. Two of one name and side are variants of which only one applies to a context. To add a
# bound: `BOUNDS.append(Mine())`, before anything is certified.
BOUNDS: list[Bound] = [
    PenalisedDual(),
    RecordedDual(),
    Shifted(),
    Rigorous(),
    PenalisedPrimal(),
    RecordedPrimal(),
    MinimisedPrimal(),
    Lagrangian(),
    Evaluation(),
    EvaluationBelow(),
    LagrangianBelow(),
]


def on(side: str) -> dict[str, Bound]:
    """The bounds on ``side`` by name, the last of each name, in the order of the list."""
    return {bound.name: bound for bound in BOUNDS if bound.side == side}
