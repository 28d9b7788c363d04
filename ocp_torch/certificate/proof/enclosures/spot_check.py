"""A spot check of what somebody wrote by hand: enclosures hold the data themselves."""

from __future__ import annotations

import torch
from torch import Tensor

from ocp_torch.certificate.proof.box import Box
from ocp_torch.certificate.proof.enclosures.enclosure import Enclosure
from ocp_torch.certificate.proof.enclosures.lipschitz import EVALUATION
from ocp_torch.problems.problem import Problem


def contradiction(problem: Problem, box: Box, enclosure: Enclosure, t: Tensor) -> str | None:
    """The name of a part of ``enclosure`` that does not hold the problem's own data at `centre + half t`, if there is one.

    ``t`` is ``(N, d)`` with entries in `[-1, 1]`.
    """
    x = box.centre + box.half * t
    powers = torch.stack([(t ** t.new_tensor(alpha)).prod(dim=-1) for alpha in box.basis.exponents])
    data = {
        "state_cost": (enclosure.f, problem.state_cost(x)),
        "control_matrix": (enclosure.B, problem.control_matrix(x)),
        "initial_density": (enclosure.mu0, problem.initial_density(x)),
        "drift": (enclosure.a or box.constant(torch.zeros_like(x)), problem.drift(x)),
    }
    for name, (model, value) in data.items():
        shaped = powers.reshape(*powers.shape, *[1] * (value.dim() - 1))
        error = ((shaped * model.coefficients).sum(dim=0) - value).abs()
        if not bool((error <= model.radius + EVALUATION * (1.0 + value.abs())).all()):
            return name
    return None
