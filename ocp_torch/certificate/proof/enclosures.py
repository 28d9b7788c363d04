"""What a problem's data and the conjugate of a control cost can be over a cell, as Taylor models, for each class known.

To prove bounds for a class of your own, either give it a method ``enclosure(box)`` that returns an `Enclosure`, or put a
function for it into ``enclosure.known``. A problem that states its `lipschitz` constants needs neither.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from ocp_torch.certificate.proof.models import Box, absolute, power, reciprocal
from ocp_torch.certificate.proof.taylor import ROUNDING, TaylorModel, upward
from ocp_torch.certificate.proof.waves import (
    gradient_model,
    hessian_model,
    matrix_model,
    polynomial_model,
    square_divergence_model,
)
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.control_limit import BoxLimitedCost, LimitedCost
from ocp_torch.problems.exact.manufactured import Manufactured
from ocp_torch.problems.exact.torus import Torus
from ocp_torch.problems.lipschitz import Lipschitz
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced

# Assumed error of data evaluated at one state, relative to 1 + their size: it leaves 2^16 units in the last place of float64
# to the rounding of the user's formula.
EVALUATION = 2.0**-36
# Relative rounding of the few operations that constants and computed numbers take here.
FEW_ROUNDINGS = 1e-12


@dataclass(frozen=True)
class Enclosure:
    """Models over `N` cells; ``a`` is `None` where there is no drift, ``noise`` where there is none."""

    f: TaylorModel  # (N,)
    a: TaylorModel | None  # (N, d)
    B: TaylorModel  # (N, d, m)
    mu0: TaylorModel  # (N,)
    noise: TaylorModel | None = None  # (N, d, k)


def lipschitz_enclosure(problem: Problem, box: Box) -> Enclosure | None:
    """The data at the centre of each cell, up to the Lipschitz constant times half of the cell's diagonal; `None` if a
    constant is unknown. What ``problem`` does not override is constant. The data are those of the instance itself, whatever
    class changes them."""
    declared = problem.lipschitz if problem.lipschitz is not None else Lipschitz()
    diagonal = box.half.norm(dim=-1)
    models = {}
    for name, constant in vars(declared).items():
        value: Tensor | None = getattr(problem, name)(box.centre)
        if value is None:  # no noise
            continue
        if not replaced(problem, name, Problem):
            constant = 0.0
        if constant is None:
            return None
        reach = (constant * diagonal).reshape(-1, *[1] * (value.dim() - 1))
        models[name] = box.constant(value, (1.0 + FEW_ROUNDINGS) * reach + EVALUATION * (1.0 + value.abs()))
    drift = None if problem.driftless else models["drift"]
    return Enclosure(
        models["state_cost"], drift, models["control_matrix"], models["initial_density"], models.get("noise")
    )


def constant_noise(problem: Problem, box: Box) -> TaylorModel | None:
    """`sigma` ``(N, d, d)`` of the argument ``noise`` of a problem; `None` where it is 0."""
    sigma = Problem.noise(problem, box.centre)
    return None if sigma is None else box.constant(sigma, ROUNDING * sigma)


def power_conjugate(cost: PowerCost, p: TaylorModel) -> TaylorModel:
    """`R*(p) = |p|^{q'} / q'` as a power of `|p|^2`, which is smooth."""
    return power((p * p).sum(), 0.5 * cost.conjugate_exponent) * (1.0 / cost.conjugate_exponent)


def limited_conjugate(cost: LimitedCost, p: TaylorModel) -> TaylorModel:
    """`R_c*(p)`: `R*` below `|p| = c^{q-1}`, linear above. A cell on both sides takes `R*` less its excess over `R_c*`, which
    grows quadratically from 0 at the knee: it lies between 0 and its value at the largest `|p|`."""
    near, squares = power_conjugate(cost, p), (p * p).sum()
    low, high = squares.bounds()
    far = power(squares, 0.5) * cost.limit + (-cost.largest)
    top = upward(high.clamp_min(0.0).sqrt())
    parts = top**cost.conjugate_exponent / cost.conjugate_exponent, cost.limit * top, cost.largest
    excess = upward((parts[0] - parts[1] + parts[2]).clamp_min(0.0) + FEW_ROUNDINGS * sum(parts))
    across = near + TaylorModel.constant(-0.5 * excess, upward(0.5 * excess + ROUNDING * excess), near.basis)
    knee = cost.knee**2
    inside, outside = high <= (1.0 - FEW_ROUNDINGS) * knee, low >= (1.0 + FEW_ROUNDINGS) * knee
    return near.where(inside, far.where(outside, across))


def box_limited_conjugate(cost: BoxLimitedCost, p: TaylorModel) -> TaylorModel:
    """The sum of the conjugates of the actuators, each of which has its own limit."""
    each = enumerate(LimitedCost(cost.q, c) for c in cost.limit)
    return TaylorModel.stack([limited_conjugate(own, p[..., i : i + 1]) for i, own in each]).sum()


def torus_enclosure(problem: Torus, box: Box) -> Enclosure:
    """With `s = y - n` and `n` the nearest integer, `(y_i - 1/2)^2 = s^2 - |s| + 1/4`: only `|s|` has a kink in the cell."""
    d = problem.dim
    y = TaylorModel.stack([(box.coordinates() * row).sum() for row in problem.A.to(box.centre)])
    s = y - y.coefficients[0].round()
    square = s * s - absolute(s) + 0.25
    # Beyond |s| = 1 the identity fails: of a cell that large only the range [0, 1/4] is known.
    far = s.size >= 1.0
    parts = square.where(~far, box.constant(torch.full_like(s.radius, 0.125), 0.125))
    B = box.constant(problem.A_inverse.to(box.centre).expand(len(box), d, d))
    return Enclosure(parts.sum() * (1.0 / d), None, B, box.constant(1.0), constant_noise(problem, box))


def manufactured_enclosure(problem: Manufactured, box: Box) -> Enclosure | None:
    """The formulas of `state_cost` and `drift` in models, with the optimal control near its zeros by its size alone; `None`
    where `u*` is clipped: there are no models of its kinks yet."""
    if problem.limited:
        return None
    rho, q, conjugate = problem.discount, problem.exponent, problem.control_cost.conjugate_exponent
    V0, slope = polynomial_model(problem.V0, box), gradient_model(problem.V0, box)
    mu, mu0 = polynomial_model(problem.mu, box), polynomial_model(problem.mu0, box)
    flux = gradient_model(problem.phi, box) * rho + TaylorModel.stack(
        [polynomial_model(h, box) for h in problem.stream.components]
    )
    sigma = constant_noise(problem, box) if problem.sigma is None else matrix_model(problem.sigma, box)
    if sigma is not None:
        D = (sigma[:, None] * sigma[None]).sum() * 0.5
        flux = flux + (D * gradient_model(problem.mu, box)[None]).sum()
        if problem.sigma is not None:
            flux = flux + square_divergence_model(problem.sigma, box) * mu[..., None]
    closed_loop = flux * reciprocal(mu)[..., None]
    B = matrix_model(problem.B, box)
    pull = (B * slope[..., None]).sum(dim=-2) * (-1.0 / rho)
    squares = (pull * pull).sum()
    u = pull if q == 2.0 else pull * power(squares, 0.5 * conjugate - 1.0)[..., None]
    cost = power(squares, 0.5 * conjugate) * (1.0 / q)
    along = (slope * closed_loop).sum()
    if sigma is not None:
        along = along + (D * hessian_model(problem.V0, box)).sum().sum()
    f = V0 - along * (1.0 / rho) - cost + problem.c
    return Enclosure(f, closed_loop - (B * u[None]).sum(), B, mu0, sigma)


@dataclass(frozen=True)
class ByClass:
    """A function of an object and an argument, given by a ``method`` of the object's own class or ``known`` for a class.

    The most derived class that gives it counts. The function describes the methods ``about`` of the object, so it cannot be
    trusted where a class further down changes one of them. ``default``, for the rest, follows all such changes.
    """

    method: str
    about: tuple[str, ...]
    known: dict[type, Callable]
    default: Callable | None = None

    def _source(self, owner: object) -> tuple[Callable | None, bool]:
        """The function for ``owner``, if there is one, and whether it can be trusted."""
        changes = lambda names: any(name in names for name in self.about)
        unchanged = not changes(vars(owner))
        for cls in type(owner).__mro__:
            if self.method in vars(owner) or self.method in vars(cls):
                return getattr(owner, self.method), unchanged
            if cls in self.known:
                return partial(self.known[cls], owner), unchanged
            unchanged = unchanged and not changes(vars(cls))
        return self.default and partial(self.default, owner), self.default is not None

    def holds_for(self, owner: object) -> bool:
        """Whether there is a function for ``owner``, and neither ``owner`` nor a class below the one that gives it changes
        what it describes."""
        return self._source(owner)[1]

    def __call__(self, owner: object, argument: Any) -> Any:
        function, _ = self._source(owner)
        if function is None:
            raise TypeError(f"{type(owner).__name__} gives no {self.method}.")
        return function(argument)


# enclosure(problem, box): an `Enclosure` of the data of ``problem`` over the cells of ``box``, or `None` where it has none.
enclosure = ByClass(
    "enclosure",
    ("state_cost", "drift", "control_matrix", "initial_density", "noise"),
    known={Torus: torus_enclosure, Manufactured: manufactured_enclosure},
    default=lipschitz_enclosure,
)
# conjugate_model(cost, p): `R*(p)` ``(N,)`` for a model `p` ``(N, m)``.
conjugate_model = ByClass(
    "conjugate_model",
    ("conjugate",),
    known={PowerCost: power_conjugate, LimitedCost: limited_conjugate, BoxLimitedCost: box_limited_conjugate},
)
