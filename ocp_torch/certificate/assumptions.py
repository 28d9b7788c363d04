r"""The assumptions the bounds rest on, checked under the learned controller as far as that can be done."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import torch
from torch import Tensor

from ocp_torch import calculus
from ocp_torch.bounds import FROM_PROBLEM, Bounds
from ocp_torch.certificate.simulation import discounted_integral
from ocp_torch.control_laws import ControlLaw
from ocp_torch.problems.problem import Problem

# An estimated supremum may exceed a bound by so much before it contradicts it.
TOLERANCE = 0.02


@dataclass(frozen=True)
class Assumptions:
    """The constants used, what was estimated beside them, and whether every check passed.

    ``occupation_holds`` and ``value_holds`` say which bounds stand: `F_M` needs the first, `J` and `G` the second.
    """

    M: float | None
    C_V: float | None
    C_u: float
    estimated_sup_occupation: float | None
    sup_control: float | None
    occupation_holds: bool
    value_holds: bool
    control_holds: bool

    @property
    def hold(self) -> bool:
        return self.occupation_holds and self.value_holds and self.control_holds

    def with_value_bound(self, C_V: float) -> Assumptions:
        """With a `C_V` that was proved for the controller at hand."""
        return replace(self, C_V=C_V, value_holds=True, control_holds=True)

    def to_dict(self) -> dict:
        """JSON form; a supremum that grew beyond all numbers is null."""
        numbers = {k: v for k, v in asdict(self).items() if not k.endswith("_holds")}
        finite = {k: v if v is None or math.isfinite(v) else None for k, v in numbers.items()}
        return {**finite, "hold": self.hold}


def occupation_along_flow(problem: Problem, law: ControlLaw, x: Tensor, horizon: float, steps: int) -> Tensor:
    r"""`mu^u(x) = rho int e^{-rho t} mu0(y_t) exp(-int_0^t div g(y_s) ds) dt` along `dy/dt = -g(y)`, `y_0 = x`; ``(N,)``.

    The density of a flow changes by its divergence (the representation behind Proposition 8 of the paper); valid for a
    Lipschitz closed loop `g = a + B u`. The logarithm of the second factor is carried as one more coordinate.
    """
    velocity = lambda y: problem.velocity(y, law(y))

    def backward(state: Tensor) -> tuple[Tensor, Tensor]:
        y, log_factor = state[:, :-1], state[:, -1]
        spread = calculus.divergence(velocity, y)
        motion = torch.cat([-velocity(y), -spread.unsqueeze(-1)], dim=-1)
        return motion, problem.initial_density(y) * log_factor.clamp_max(60.0).exp()

    start = torch.cat([x, x.new_zeros(len(x), 1)], dim=-1)
    density, _ = discounted_integral(backward, start, problem.discount, horizon, steps)
    return density


def estimated_sup_occupation(problem: Problem, law: ControlLaw, end_states: Tensor, states: int) -> float:
    """The largest `mu^u` met at the ends of trajectories, where mass accumulates, and at uniform states."""
    count = max(1, 2 * states // 3)
    picked = end_states[:: max(1, len(end_states) // count)][:count]
    uniform = torch.rand(
        states - len(picked), problem.dim, dtype=picked.dtype, generator=torch.Generator().manual_seed(0)
    )
    x = torch.cat([picked, uniform.to(picked.device)])
    horizon = 8.0 / problem.discount
    speed = float(problem.velocity(x, law(x)).norm(dim=-1).max())
    steps = int(min(400, max(40, math.ceil(horizon * max(problem.discount / 0.2, speed / 0.05)))))
    density = occupation_along_flow(problem, law, x, horizon, steps)
    return float(density.nan_to_num(nan=math.inf).max())


def check_assumptions(
    problem: Problem,
    bounds: Bounds,
    occupation_estimate: float | None,
    sup_control: float | None,
    largest_value: float | None,
    uses: tuple[bool, bool],
) -> tuple[Assumptions, list[str]]:
    """Hold what was measured against ``bounds``; ``uses`` says whether a lower and an upper side are in the certificate."""
    uses_M, uses_C_V = uses
    warnings: list[str] = []
    M_holds, why = _occupation_holds(problem, bounds, occupation_estimate)
    if uses_M and not M_holds:
        warnings.append(f"F_M is not used: {why}.")
    value_holds = largest_value is None or largest_value <= bounds.C_V * (1.0 + 1e-3)
    if uses_C_V and not value_holds:
        warnings.append(
            f"J and G are not used: the controller's value reaches {largest_value:.4g}, above C_V = {bounds.C_V:.4g}."
        )
    control_holds = sup_control is None or sup_control <= bounds.C_u * (1.0 + TOLERANCE)
    if not control_holds:
        warnings.append(f"the control reaches {sup_control:.4g}, beyond C_u = {bounds.C_u:.4g}.")
    assumptions = Assumptions(
        bounds.M if uses_M else None,
        bounds.C_V if uses_C_V else None,
        bounds.C_u,
        occupation_estimate,
        sup_control,
        occupation_holds=M_holds or not uses_M,
        value_holds=value_holds or not uses_C_V,
        control_holds=control_holds or not uses_C_V,
    )
    return assumptions, warnings


def _occupation_holds(problem: Problem, bounds: Bounds, estimate: float | None) -> tuple[bool, str]:
    true = problem.occupation_bound
    if true is not None and math.isinf(true):
        return False, "mu* is unbounded for this problem, so no M is large enough"
    if bounds.sources["M"] == FROM_PROBLEM:
        return True, ""
    if true is not None and bounds.M >= true:
        return True, ""
    largest = max(estimate or 0.0, true or 0.0)
    if bounds.M * (1.0 + TOLERANCE) >= largest and (estimate is None or math.isfinite(estimate)):
        return True, ""
    return False, f"M = {bounds.M:.4g}, but the occupation density reaches about {largest:.4g}"
