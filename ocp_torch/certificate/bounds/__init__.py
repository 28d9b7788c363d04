"""The bounds of a certificate, listed once: gaps, tables, files and the benchmark's columns follow from this list."""

from ocp_torch.certificate.bounds.bound import Bound
from ocp_torch.certificate.bounds.evaluation import Evaluation, EvaluationBelow
from ocp_torch.certificate.bounds.lagrangian import Lagrangian, LagrangianBelow
from ocp_torch.certificate.bounds.minimised_primal import MinimisedPrimal
from ocp_torch.certificate.bounds.penalised_dual import PenalisedDual, RecordedDual
from ocp_torch.certificate.bounds.penalised_primal import PenalisedPrimal, RecordedPrimal
from ocp_torch.certificate.bounds.rigorous import Rigorous
from ocp_torch.certificate.bounds.shifted import Shifted

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
