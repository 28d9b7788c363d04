"""Why nothing can be proved of a network on a problem: told before any cell is evaluated."""

import torch
from torch import Tensor

from ocp_torch.certificate.proof.box import Box, equal_cells
from ocp_torch.certificate.proof.cover import DEGREE
from ocp_torch.certificate.proof.enclosures import EVALUATION, Enclosure, conjugate_model, enclosure
from ocp_torch.certificate.proof.network_model import is_known
from ocp_torch.maths.jets import Field
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.problem import Problem

# The number of cells that a tolerance takes grows exponentially with the dimension.
MOST_DIMENSIONS = 2
# An enclosure is held against the data in so many cells per coordinate, whole and shrunk to 2^-8 of their size, where a wrong
# value is not hidden by the radius.
SPOT_CELLS, SPOT_SIZES = 16, (1.0, 2.0**-8)


def obstacle(problem: Problem, value: Field) -> str | None:
    """Why there can be no rigorous bound for ``value`` on ``problem``; `None` where there can."""
    if problem.dim > MOST_DIMENSIONS:
        return f"cells cover the torus in at most {MOST_DIMENSIONS} dimensions, and this problem has {problem.dim}"
    if not is_known(value):
        return "V is not one of the package's own scalar networks"
    weights = [*value.parameters(), *value.buffers()]
    if not all(bool(torch.isfinite(w).all()) for w in weights):
        return "V has weights that are not finite"
    if not all(w.dtype == torch.float64 and w.device.type == "cpu" for w in weights):
        return "V is not in float64 on the CPU"
    if not enclosure.holds_for(problem) or not conjugate_model.holds_for(problem.control_cost):
        return "the problem's class changes its data, but not the enclosure it inherits"
    generator = fixed_generator()
    box = equal_cells(problem.dim, SPOT_CELLS, DEGREE[problem.dim])
    if enclosure(problem, box) is None:
        return "the problem gives neither an enclosure of its data nor their Lipschitz constants (lipschitz)"
    for size in SPOT_SIZES:
        small = Box(box.centre, size * box.half, box.degree)
        t = 2.0 * torch.rand(box.centre.shape, generator=generator, dtype=torch.float64) - 1.0
        wrong = contradiction(problem, small, enclosure(problem, small), t)
        if wrong is not None:
            return f"the problem's enclosure does not hold its own {wrong}"
    return None


def contradiction(problem: Problem, box: Box, found: Enclosure, t: Tensor) -> str | None:
    """The name of a part of the enclosure ``found`` that does not hold the problem's own data at `centre + half t`, if there
    is one: what somebody wrote by hand may be wrong. ``t`` is ``(N, d)`` with entries in `[-1, 1]`."""
    x = box.centre + box.half * t
    powers = torch.stack([(t ** t.new_tensor(alpha)).prod(dim=-1) for alpha in box.basis.exponents])
    models = {"state_cost": found.f, "control_matrix": found.B, "initial_density": found.mu0}
    models["drift"] = found.a or box.constant(torch.zeros_like(x))
    for name, model in models.items():
        value = getattr(problem, name)(x)
        shaped = powers.reshape(*powers.shape, *[1] * (value.dim() - 1))
        error = ((shaped * model.coefficients).sum(dim=0) - value).abs()
        if not bool((error <= model.radius + EVALUATION * (1.0 + value.abs())).all()):
            return name
    return None
