"""A problem's data over a batch of cells: Taylor models of `f`, `a`, `B` and `mu0`, or what Lipschitz constants give."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.maths.taylor import Box, TaylorModel

# Data evaluated at the centre of a cell are taken to be right up to so much, relative to 1 + their size.
EVALUATION = 2.0**-36


@dataclass(frozen=True)
class Enclosure:
    """Models over `N` cells; ``a`` is `None` where there is no drift."""

    f: TaylorModel  # (N,)
    a: TaylorModel | None  # (N, d)
    B: TaylorModel  # (N, d, m)
    mu0: TaylorModel  # (N,)


@dataclass(frozen=True)
class Lipschitz:
    """`|g(x) - g(y)| <= L |x - y|`, Euclidean, for each entry of the data; 0 for a constant, `None` where unknown.

    A method that is not overridden needs none.
    """

    state_cost: float | None = None
    drift: float | None = None
    control_matrix: float | None = None
    initial_density: float | None = None


def lipschitz_enclosure(problem, base: type, box: Box) -> Enclosure | None:
    """The data at the centre of each cell up to the constant times the cell's half-diagonal; `None` if one is unknown.

    What ``problem`` takes over from ``base`` is constant.
    """
    declared = problem.lipschitz if problem.lipschitz is not None else Lipschitz()
    diagonal = box.half.norm(dim=-1)
    models = {}
    for name, constant in vars(declared).items():
        if getattr(type(problem), name) is getattr(base, name):
            constant = 0.0
        if constant is None:
            return None
        value: Tensor = getattr(problem, name)(box.centre)
        reach = (constant * diagonal).reshape(-1, *[1] * (value.dim() - 1))
        radius = (1.0 + 1e-12) * reach + EVALUATION * (1.0 + value.abs())
        models[name] = box.constant(value, radius)
    drift = None if problem.driftless else models["drift"]
    return Enclosure(models["state_cost"], drift, models["control_matrix"], models["initial_density"])


def contradiction(problem, box: Box, enclosure: Enclosure, t: Tensor) -> str | None:
    """The name of a part of ``enclosure`` that does not hold the problem's own data at `centre + half t`, if there is one.

    A spot check of what somebody wrote by hand; ``t`` is ``(N, d)`` with entries in `[-1, 1]`.
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
