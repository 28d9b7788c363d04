"""The conjugate `R*` of the control costs that the package knows."""

from __future__ import annotations

from ocp_torch.certificate.proof.enclosures.enclosure import conjugate_model
from ocp_torch.certificate.proof.functions import power
from ocp_torch.certificate.proof.rounding import ROUNDING, upward
from ocp_torch.certificate.proof.taylor import TaylorModel
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.control_limit import LimitedCost

# Relative rounding of the few operations that computed numbers are compared by here.
FEW_ROUNDINGS = 1e-12


@conjugate_model.register(PowerCost)
def power_conjugate(cost: PowerCost, p: TaylorModel) -> TaylorModel:
    """`R*(p) = |p|^{q'} / q'` as a power of `|p|^2`, which is smooth."""
    return power((p * p).sum(), 0.5 * cost.conjugate_exponent) * (1.0 / cost.conjugate_exponent)


@conjugate_model.register(LimitedCost)
def limited_conjugate(cost: LimitedCost, p: TaylorModel) -> TaylorModel:
    """`R_c*(p)`: `R*` below `|p| = c^{q-1}`, linear above. A cell on both sides takes `R*` less what that exceeds `R_c*` by:
    between 0 and its value at the largest `|p|`, as it grows quadratically from 0 at the knee."""
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
