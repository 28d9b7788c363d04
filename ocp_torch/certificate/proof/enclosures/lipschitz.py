"""Any problem that states the Lipschitz constants of its data (`ocp_torch.problems.lipschitz`)."""

from __future__ import annotations

from torch import Tensor

from ocp_torch.certificate.proof.box import Box
from ocp_torch.certificate.proof.enclosures.enclosure import Enclosure, enclosure
from ocp_torch.problems.lipschitz import Lipschitz
from ocp_torch.problems.problem import Problem

# Data evaluated at one state are taken to be right up to so much, relative to 1 + their size: 2^16 units in the last place
# of float64 are left to the rounding of the user's formula.
EVALUATION = 2.0**-36
# Makes up for the rounding of a constant times a distance.
PRODUCT_ROUNDING = 1.0 + 1e-12


@enclosure.register(Problem, always=True)
def lipschitz_enclosure(problem: Problem, box: Box) -> Enclosure | None:
    """The data at the centre of each cell, up to the constant times half of the cell's diagonal; `None` if one is unknown.

    What ``problem`` does not override is constant. It is the problem's own data that are evaluated, so a subclass is served
    whatever it changes.
    """
    declared = problem.lipschitz if problem.lipschitz is not None else Lipschitz()
    diagonal = box.half.norm(dim=-1)
    models = {}
    for name, constant in vars(declared).items():
        if getattr(type(problem), name) is getattr(Problem, name) and name not in vars(problem):
            constant = 0.0
        if constant is None:
            return None
        value: Tensor = getattr(problem, name)(box.centre)
        reach = (constant * diagonal).reshape(-1, *[1] * (value.dim() - 1))
        models[name] = box.constant(value, PRODUCT_ROUNDING * reach + EVALUATION * (1.0 + value.abs()))
    drift = None if problem.driftless else models["drift"]
    return Enclosure(models["state_cost"], drift, models["control_matrix"], models["initial_density"])
