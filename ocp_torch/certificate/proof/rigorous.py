r"""A lower bound on `OPT` proved for the network as it stands, in one and two dimensions.

For any smooth `W`, `W - sup_x Q_W(x)` is a subsolution of the HJB equation, so `E[W mu0] - sup_x Q_W(x) <= OPT` for a
density `mu0` (mean 1). Here
`W = theta V`, and both the supremum and the integral are enclosed over cells that cover the torus, bisected until the
bound is tight: nothing is sampled, no `M` is used.

What is proved: `value <= OPT`, for the `W` that the float64 weights define in real arithmetic. What is assumed: the
problem's `enclosure` (or its Lipschitz constants) is true; float64 arithmetic rounds to nearest; matrix products add up
their products in some order; library functions are accurate to 16 units in the last place. All rounding is accounted for
(`ocp_torch.maths.taylor`, `ocp_torch.certificate.proof.network_model`).
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ocp_torch.certificate.estimate import Estimate
from ocp_torch.certificate.lower.shifted import slack_function
from ocp_torch.certificate.proof.activations import SERIES
from ocp_torch.certificate.proof.network_model import network_model
from ocp_torch.errors import require_integer, require_number
from ocp_torch.fields.mlp import Gated, PeriodicMLP
from ocp_torch.maths.enclosure import contradiction
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.supremum import supremum
from ocp_torch.maths.taylor import ROUNDING, Box, TaylorModel, upward
from ocp_torch.problems.problem import Problem

MOST_DIMENSIONS = 2
DEGREE = {1: 4, 2: 5}
# How close to the sampled supremum, relative to the bound, by dimension.
TOLERANCE = {1: 1e-5, 2: 1e-3}
# Cells are not bisected below this half-width: all centres, and their multiples by wave numbers, are then exact.
SMALLEST_HALF = 2.0**-32
# Cells a side to start with, and cells evaluated at once.
FIRST_CELLS = {1: 64, 2: 32}
CHUNK = 256


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
    seconds: float
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


def obstacle(problem: Problem, value: nn.Module) -> str | None:
    """Why there can be no rigorous bound for ``value`` on ``problem``; `None` where there can."""
    if problem.dim > MOST_DIMENSIONS:
        return f"cells cover the torus in at most {MOST_DIMENSIONS} dimensions, and this problem has {problem.dim}"
    if type(value) is not PeriodicMLP or not value.scalar or not all(map(_known, value.body.modules())):
        return "V is not one of the package's own scalar networks"
    weights = [*value.parameters(), *value.buffers()]
    if not all(bool(torch.isfinite(w).all()) for w in weights):
        return "V has weights that are not finite"
    if not all(w.dtype == torch.float64 and w.device.type == "cpu" for w in weights):
        return "V is not in float64 on the CPU"
    data = ("state_cost", "drift", "control_matrix", "initial_density")
    if not _speaks_for(problem, "enclosure", data) or not _speaks_for(
        problem.control_cost, "conjugate_model", ("conjugate",)
    ):
        return "the problem's class changes its data, but not the enclosure it inherits"
    generator = torch.Generator().manual_seed(0)
    box = _cells(problem.dim, 16, DEGREE[problem.dim])
    enclosure = problem.enclosure(box)
    if enclosure is None:
        return "the problem gives neither an enclosure of its data nor their Lipschitz constants (lipschitz)"
    for half in (1.0, 2.0**-8):
        small = Box(box.centre, half * box.half, box.degree)
        t = 2.0 * torch.rand(box.centre.shape, generator=generator, dtype=torch.float64) - 1.0
        wrong = contradiction(problem, small, problem.enclosure(small), t)
        if wrong is not None:
            return f"the problem's enclosure does not hold its own {wrong}"
    return None


def _known(layer: nn.Module) -> bool:
    """Whether this is a layer that `network_model` encloses, the activations in their plain form."""
    plain = getattr(layer, "approximate", "none") == "none" and getattr(layer, "beta", 1.0) == 1.0
    return plain and type(layer) in (nn.Sequential, nn.Linear, Gated, *SERIES)


def _speaks_for(owner: object, claim: str, methods: tuple[str, ...]) -> bool:
    """Whether no class below the one that defines ``claim`` changes one of ``methods``."""
    line = type(owner).__mro__
    where = lambda name: next(i for i, c in enumerate(line) if name in vars(c))
    general = getattr(type(owner), claim) is getattr(Problem, claim, None)
    return general or all(where(claim) <= where(name) and name not in vars(owner) for name in methods)


def _cells(dim: int, side: int, degree: int) -> Box:
    edges = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    centre = torch.cartesian_prod(*[edges] * dim).reshape(-1, dim)
    return Box(centre, torch.full_like(centre, 0.5 / side), degree)


@torch.no_grad()
def cell_models(problem: Problem, value: PeriodicMLP, theta: float, box: Box) -> tuple[TaylorModel, TaylorModel]:
    """`Q` and `W mu0` for `W = theta V`, both ``(N,)``, over ``box``."""
    data, rho = problem.enclosure(box), problem.discount
    V, gradient = network_model(value, box)
    V, gradient = V * theta, gradient * theta
    pushed = (data.B * gradient[:, None]).sum(dim=-2) * (-1.0 / rho)
    Q = V - data.f + problem.control_cost.conjugate_model(pushed)
    if data.a is not None:
        Q = Q - (gradient * data.a).sum() * (1.0 / rho)
    return Q, V * data.mu0


@dataclass
class _Cover:
    """Cells with what is proved on each: ``upper`` of `sup Q`, ``reached`` from below, and ``mean`` and ``radius`` of
    `W mu0` times its volume; ``axis`` is where to bisect it."""

    centre: Tensor
    half: Tensor
    upper: Tensor
    reached: Tensor
    mean: Tensor
    radius: Tensor
    axis: Tensor

    def take(self, index: Tensor) -> _Cover:
        return _Cover(*(column[index] for column in vars(self).values()))

    @staticmethod
    def join(parts: list[_Cover]) -> _Cover:
        return _Cover(*(torch.cat(columns) for columns in zip(*(vars(p).values() for p in parts), strict=True)))

    def split(self) -> tuple[Tensor, Tensor, Tensor]:
        """Both halves of each cell along its ``axis``, and the parents' ``upper``."""
        hot = nn.functional.one_hot(self.axis, self.half.shape[1]).to(self.half)
        half = self.half * (1.0 - 0.5 * hot)
        shift = half * hot
        return torch.cat([self.centre - shift, self.centre + shift]), half.repeat(2, 1), self.upper.repeat(2)


def _evaluate(problem: Problem, value: PeriodicMLP, theta: float, centre: Tensor, half: Tensor) -> _Cover:
    box = Box(centre, half, DEGREE[problem.dim])
    Q, initial = cell_models(problem, value, theta, box)
    _, upper = Q.bounds()
    mean, radius = initial.mean()
    volume = (2.0 * half).prod(dim=-1)
    # What makes the bound of Q loose: everything of second order, and the radius, most along the longest side.
    exponents = half.new_tensor(box.basis.exponents)
    exponents[box.basis.ends[1] : box.basis.ends[2]] = 0.0
    bent = torch.einsum("kn,ki->ni", Q.coefficients.abs(), exponents)
    loose = bent + Q.radius.unsqueeze(-1) * half / half.sum(dim=-1, keepdim=True)
    axis = loose.nan_to_num(nan=math.inf, posinf=math.inf).argmax(dim=-1)
    axis = torch.where(half.amax(dim=-1) > 4.5 * half.amin(dim=-1), half.argmax(dim=-1), axis)
    upper = upper.nan_to_num(nan=math.inf, posinf=math.inf)
    reached = (Q.coefficients[0] - Q.radius).nan_to_num(nan=-math.inf)
    return _Cover(centre, half, upper, reached, mean * volume, radius * volume, axis)


def rigorous_lower_bound(
    problem: Problem,
    value: PeriodicMLP,
    *,
    theta: float = 1.0,
    sampled_slack: float | None = None,
    tolerance: float | None = None,
    cells: int = 2**18,
    seconds: float | None = None,
) -> RigorousBound | None:
    r"""`E[theta V mu0] - sup Q <= OPT`, proved; `None` where `obstacle` says why there is none, or nothing finite was found.

    Cells are bisected, worst first, until `sup Q` is known within ``tolerance``, relative to `E|theta V mu0|`, of
    ``sampled_slack`` (searched for when not given), or until ``cells`` have been evaluated or ``seconds`` have passed:
    the bound stands then as well, only less tight. ``value`` must be in float64 on the CPU.
    """
    require_integer("certificate.rigorous cells", cells, 1)
    if obstacle(problem, value) is not None:
        return None
    tolerance = TOLERANCE[problem.dim] if tolerance is None else tolerance
    require_number("certificate.rigorous tolerance", tolerance, above=0.0)
    started = time.monotonic()
    points = scrambled_sobol(2**14, problem.dim, 0, torch.float64)
    size = _scale(problem, value, theta, points)
    if sampled_slack is None:
        sampled_slack = supremum(slack_function(problem, lambda x: theta * value(x)), points).value
    first = _cells(problem.dim, FIRST_CELLS[problem.dim], DEGREE[problem.dim])
    evaluate = lambda centre, half: _evaluate(problem, value, theta, centre, half)
    parts = [evaluate(c, h) for c, h in zip(first.centre.split(CHUNK), first.half.split(CHUNK), strict=True)]
    pending, count = _Cover.join(parts), len(first)
    slack, means, radii = -math.inf, [], []
    goal, complete = sampled_slack + tolerance * size, False
    while True:
        # Where Q is larger than was met by sampling, more cannot be proved.
        goal = max(goal, float(pending.reached.max()) + tolerance * size)
        # The radius of W mu0 is held per volume, so that all cells together keep theirs.
        volume = (2.0 * pending.half).prod(dim=-1)
        done = (pending.upper <= goal) & (pending.radius <= 0.1 * tolerance * size * volume)
        done |= pending.half.amax(dim=-1) <= SMALLEST_HALF
        if bool(done.any()):
            finished = pending.take(done)
            slack = max(slack, float(finished.upper.max()))
            means += finished.mean.tolist()
            radii += finished.radius.tolist()
            pending = pending.take(~done)
        complete = len(pending.upper) == 0
        if complete or count >= cells or (seconds is not None and time.monotonic() - started > seconds):
            break
        worst = pending.upper.topk(min(CHUNK // 2, len(pending.upper))).indices
        rest = torch.ones(len(pending.upper), dtype=torch.bool)
        rest[worst] = False
        centre, half, before = pending.take(worst).split()
        halves = evaluate(centre, half)
        halves.upper = torch.minimum(halves.upper, before)
        count += len(centre)
        pending = _Cover.join([pending.take(rest), halves])
    if not complete:
        slack = max(slack, float(pending.upper.max()))
        means += pending.mean.tolist()
        radii += pending.radius.tolist()
    if not all(map(math.isfinite, (slack, *means, *radii))):
        return None
    return _conclude(slack, sampled_slack, means, radii, count, theta, time.monotonic() - started, complete)


@torch.no_grad()
def _scale(problem: Problem, value: PeriodicMLP, theta: float, x: Tensor) -> float:
    """The size of `theta V mu0`, which tolerances are relative to; not much below that of the costs."""
    initial, cost = theta * value(x) * problem.initial_density(x), problem.state_cost(x)
    return max(float(initial.abs().mean()), 1e-3 * float(cost.abs().mean()), 1e-300)


def _conclude(slack, sampled_slack, means, radii, count, theta, seconds, complete) -> RigorousBound:
    # fsum rounds once.
    middle = math.fsum(means)
    radius = float(upward(torch.tensor(math.fsum(radii) + ROUNDING * math.fsum(map(abs, means)), dtype=torch.float64)))
    low, high = math.nextafter(middle - radius, -math.inf), math.nextafter(middle + radius, math.inf)
    bound = math.nextafter(low - slack, -math.inf)
    return RigorousBound(bound, slack, sampled_slack, (low, high), count, theta, seconds, complete)
