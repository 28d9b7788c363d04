r"""A lower bound on `OPT` proved for the network as it stands, in one and two dimensions.

For any smooth `W`, `W - sup_x Q_W(x)` is a subsolution of the HJB equation, so `E[W mu0] - sup_x Q_W(x) <= OPT` for a
density `mu0` (mean 1). Here `W = theta V`, and both the supremum and the integral are enclosed over cells that cover the
torus, bisected until the bound is tight: nothing is sampled, no `M` is used.

What is proved: `value <= OPT`, for the `W` that the float64 weights define in real arithmetic. What is assumed: the
problem's enclosure (or its Lipschitz constants) is true; float64 arithmetic rounds to nearest; matrix products add up
their products in some order; library functions are accurate to 16 units in the last place. All rounding is accounted for.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.lower.shifted import slack_function
from ocp_torch.certificate.proof.cover import CHUNK, Cover
from ocp_torch.certificate.proof.network_model import is_known
from ocp_torch.certificate.proof.obstacle import obstacle
from ocp_torch.errors import require_integer, require_number
from ocp_torch.fields.mlp import PeriodicMLP
from ocp_torch.maths.jets import Field
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.problem import Problem

# How close to the sampled supremum, relative to the size of `theta V mu0`, by dimension; and the part of that which the
# integral may take.
TOLERANCE = {1: 1e-5, 2: 1e-3}
INTEGRAL_PART = 0.1
# States at which the supremum and that size are estimated beforehand, and the least size relative to that of the costs.
SAMPLED, LEAST_SIZE = 2**14, 1e-3
# Cells are not bisected below this half-width: all centres, and their multiples by wave numbers, are then exact.
SMALLEST_HALF = 2.0**-32


@dataclass(frozen=True)
class RigorousBound:
    """``value <= OPT``: `E[theta V mu0]`, in ``integral``, less ``slack >= sup Q``; ``sampled_slack`` is met, not proved.

    ``cells`` were evaluated; ``complete`` says whether the tolerance was reached before the budget.
    """

    value: float
    slack: float
    sampled_slack: float
    integral: tuple[float, float]
    cells: int
    theta: float
    complete: bool

    @property
    def estimate(self) -> Estimate:
        """The bound as an entry of the certificate; there is nothing random in it."""
        return Estimate(self.value, 0.0)

    @property
    def sentence(self) -> str:
        """What was proved, for the terminal."""
        low, high = self.integral
        return (
            f"proved: sup Q of {self.theta:.4g} V <= {self.slack:.3e}, E[{self.theta:.4g} V mu0] in [{low:.8f}, {high:.8f}],"
            f" over {self.cells:,} cells"
        )


def rigorous_lower_bound(
    problem: Problem,
    value: Field,
    *,
    theta: float = 1.0,
    sampled_slack: float | None = None,
    tolerance: float | None = None,
    cells: int = 2**18,
) -> RigorousBound | None:
    r"""`E[theta V mu0] - sup Q <= OPT`, proved; `None` where `obstacle` says why there is none, or nothing finite was found.

    Cells are bisected, worst first, until `sup Q` is known within ``tolerance``, relative to `E|theta V mu0|`, of
    ``sampled_slack`` (searched for when not given), or until ``cells`` have been evaluated: the bound stands then as well,
    only less tight. ``value`` must be in float64 on the CPU. Raises `InputError` for a ``tolerance`` or a number of
    ``cells`` that is not positive.
    """
    require_integer("certificate.rigorous cells", cells, 1)
    if not is_known(value) or obstacle(problem, value) is not None:
        return None
    tolerance = TOLERANCE[problem.dim] if tolerance is None else tolerance
    require_number("certificate.rigorous tolerance", tolerance, above=0.0)
    points = scrambled_sobol(SAMPLED, problem.dim, 0, torch.float64)
    room = tolerance * _size(problem, value, theta, points)
    if sampled_slack is None:
        sampled_slack = supremum(slack_function(problem, lambda x: theta * value(x)), points).value
    pending, finished = Cover.first(problem, value, theta), []
    count, goal = len(pending), sampled_slack + room
    while True:
        # Where Q is larger than was met by sampling, more cannot be proved.
        goal = max(goal, float(pending.reached.max()) + room)
        done = _settled(pending, goal, room)
        finished.append(pending.take(done))
        pending = pending.take(~done)
        if not len(pending) or count >= cells:
            break
        worst = pending.upper.topk(min(CHUNK // 2, len(pending))).indices
        rest = torch.ones(len(pending), dtype=torch.bool)
        rest[worst] = False
        parents = pending.take(worst)
        halves = Cover.of(problem, value, theta, *parents.halves())
        halves.upper = torch.minimum(halves.upper, parents.upper.repeat(2))
        count += len(halves)
        pending = Cover.join([pending.take(rest), halves])
    cover = Cover.join([*finished, pending])
    if not all(bool(column.isfinite().all()) for column in (cover.upper, cover.mean, cover.radius)):
        return None
    (low, high), slack = cover.integral(), float(cover.upper.max())
    bound = math.nextafter(low - slack, -math.inf)
    return RigorousBound(bound, slack, sampled_slack, (low, high), count, theta, complete=not len(pending))


def _settled(cells: Cover, goal: float, room: float) -> Tensor:
    """Which cells ``(N,)`` need no bisection: `Q` is below ``goal`` and the integral is known, or they are too small."""
    # The radius of W mu0 is held per volume, so that all cells together keep theirs.
    volume = (2.0 * cells.half).prod(dim=-1)
    settled = (cells.upper <= goal) & (cells.radius <= INTEGRAL_PART * room * volume)
    return settled | (cells.half.amax(dim=-1) <= SMALLEST_HALF)


@torch.no_grad()
def _size(problem: Problem, value: PeriodicMLP, theta: float, x: Tensor) -> float:
    """The size of `theta V mu0`, which tolerances are relative to; not much below that of the costs."""
    initial, cost = theta * value(x) * problem.initial_density(x), problem.state_cost(x)
    return max(float(initial.abs().mean()), LEAST_SIZE * float(cost.abs().mean()), 1e-300)
