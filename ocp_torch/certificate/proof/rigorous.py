r"""A lower bound on `OPT` proved for the network as it stands, in one and two dimensions.

It is the shifted bound `E[W mu0] - sup Q_W` of `W = theta V`, for a density `mu0` (mean 1). The supremum and the integral
are enclosed over cells that cover the torus, bisected until the bound is tight: nothing is sampled, no `M` is used.

What is proved: `value <= OPT`, for the `W` that the float64 weights define in real arithmetic. What is assumed: the
problem's enclosure (or its Lipschitz constants) is true; float64 arithmetic rounds to nearest; matrix products add up
their products in some order; library functions are accurate to 16 units in the last place. All rounding is accounted for.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.certificate.proof.cover import Cover, degree
from ocp_torch.certificate.proof.declared import missing, too_small
from ocp_torch.certificate.proof.enclosures import EVALUATION, Enclosure, conjugate_model, enclosure
from ocp_torch.certificate.proof.models import Box, equal_cells
from ocp_torch.certificate.proof.network_model import is_known
from ocp_torch.errors import require_integer, require_number
from ocp_torch.maths.jets import Field
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.problem import Problem

# The number of cells that a tolerance takes grows exponentially with the dimension.
MOST_DIMENSIONS = 2
# Cells per coordinate in which an enclosure is compared with the data: of full size, and so small that their radius does not
# hide a wrong value.
SPOT_CELLS = 16
SPOT_SIZES = (1.0, 2.0**-8)
ODD_CELLS = (16, 128, 1024)  # cells per coordinate, of which those around narrow features of the data are compared too
FIRST_CELLS = {1: 64, 2: 32}  # a side to start with, by dimension
CHUNK = 256  # cells evaluated at once, which bounds the memory
# How close to the sampled supremum a proof comes, relative to the size of `theta V mu0`, by dimension.
TOLERANCE = {1: 1e-5, 2: 1e-3}
INTEGRAL_PART = 0.1  # of the tolerance, which the integral may take
SAMPLED = 2**14  # states at which the supremum and that size are estimated beforehand
LEAST_SIZE = 1e-3  # of `theta V mu0`, relative to the mean state cost
# Cells are not bisected below this half-width: all centres, and their multiples by wave numbers, are then exact.
SMALLEST_HALF = 2.0**-32


@dataclass(frozen=True)
class RigorousBound:
    """``value <= OPT``: `E[theta V mu0]`, in ``integral``, less ``slack >= sup Q``, from so many ``cells``; ``complete`` says
    whether the tolerance was reached before the budget."""

    value: float
    slack: float
    integral: tuple[float, float]
    cells: int
    theta: float
    complete: bool

    @property
    def sentence(self) -> str:
        """What was proved, for the terminal."""
        (low, high), W = self.integral, f"{self.theta:.4g} V"
        within = f"sup Q of {W} <= {self.slack:.3e}, E[{W} mu0] in [{low:.8f}, {high:.8f}]"
        short = (
            "" if self.complete else ", which ended before the tolerance was met: the bound holds, and could be tighter"
        )
        return f"proved: {within}, over {self.cells:,} cells{short}"


def obstacle(problem: Problem, value: Field, odd: Tensor | None = None) -> str | None:
    """Why there can be no rigorous bound for ``value`` on ``problem``; `None` where there can. The problem's enclosure is
    compared with its data in a few cells, and at the states ``odd`` ``(K, d)``, where a search found narrow features."""
    if problem.dim > MOST_DIMENSIONS:
        return f"cells cover the torus in at most {MOST_DIMENSIONS} dimensions, and this problem has {problem.dim}"
    if not is_known(value):
        return "V is not one of the package's own scalar networks or Sobolev fields"
    weights = [*value.parameters(), *value.buffers()]
    if not all(bool(torch.isfinite(w).all()) for w in weights):
        return "V has weights that are not finite"
    if not all(w.dtype == torch.float64 and w.device.type == "cpu" for w in weights):
        return "V is not in float64 on the CPU"
    if not enclosure.holds_for(problem) or not conjugate_model.holds_for(problem.control_cost):
        return "the problem's class changes its data, but not the enclosure it inherits"
    generator = fixed_generator()
    box = equal_cells(problem.dim, SPOT_CELLS, degree(problem))
    if enclosure(problem, box) is None:
        lacks = f" of {' and '.join(missing(problem))}" if problem.lipschitz is not None else ""
        return f"the problem gives neither an enclosure of its data nor their Lipschitz constants{lacks} (lipschitz)"
    odd = box.centre[:0] if odd is None else odd
    if (wrong := too_small(problem, odd)) is not None:
        return wrong
    for size in SPOT_SIZES:
        small = Box(box.centre, size * box.half, box.degree)
        t = 2.0 * torch.rand(box.centre.shape, generator=generator, dtype=torch.float64) - 1.0
        wrong = contradiction(problem, small, enclosure(problem, small), t)
        if wrong is not None:
            return f"the problem's enclosure does not hold its own {wrong}"
    for cells in ODD_CELLS if len(odd) else ():
        half = odd.new_full(odd.shape, 0.5 / cells)
        around = Box((2.0 * (cells * odd).floor() + 1.0) * half, half, box.degree)
        wrong = contradiction(problem, around, enclosure(problem, around), (odd - around.centre) / half)
        if wrong is not None:
            return f"the problem's enclosure does not hold its own {wrong}, which changes faster somewhere"
    return None


def contradiction(problem: Problem, box: Box, found: Enclosure, t: Tensor) -> str | None:
    """The name of a part of the enclosure ``found`` that does not hold the problem's own data at `centre + half t`, if there
    is one: an enclosure written by hand may be wrong. ``t`` is ``(N, d)`` with entries in `[-1, 1]`."""
    x = box.centre + box.half * t
    powers = torch.stack([(t ** t.new_tensor(alpha)).prod(dim=-1) for alpha in box.basis.exponents])
    models = {"state_cost": found.f, "control_matrix": found.B, "initial_density": found.mu0}
    models["drift"] = found.a or box.constant(torch.zeros_like(x))
    sigma = problem.noise(x)
    if sigma is not None or found.noise is not None:
        if sigma is None or found.noise is None or found.noise.radius.shape != sigma.shape:
            return "noise"
        models["noise"] = found.noise
    for name, model in models.items():
        value = getattr(problem, name)(x)
        shaped = powers.reshape(*powers.shape, *[1] * (value.dim() - 1))
        error = ((shaped * model.coefficients).sum(dim=0) - value).abs()
        if not bool((error <= model.radius + EVALUATION * (1.0 + value.abs())).all()):
            return name
    return None


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
    with torch.no_grad():
        initial, cost = theta * value(points) * problem.initial_density(points), problem.state_cost(points)
    room = tolerance * max(float(initial.abs().mean()), LEAST_SIZE * float(cost.abs().mean()), 1e-300)
    if sampled_slack is None:
        sampled_slack = supremum(slack_function(problem, lambda x: theta * value(x)), points).value
    first = equal_cells(problem.dim, FIRST_CELLS[problem.dim], degree(problem))
    pieces = zip(first.centre.split(CHUNK), first.half.split(CHUNK), strict=True)
    pending, finished = Cover.join([Cover.of(problem, value, theta, *piece) for piece in pieces]), []
    count, goal = len(pending), sampled_slack + room
    while True:
        # Where Q is larger than sampling met, no tighter bound can be proved.
        goal = max(goal, float(pending.reached.max()) + room)
        # The radius of W mu0 is limited per volume, so that all cells together keep to the tolerance.
        volume = (2.0 * pending.half).prod(dim=-1)
        tight = (pending.upper <= goal) & (pending.radius <= INTEGRAL_PART * room * volume)
        done = tight | (pending.half.amax(dim=-1) <= SMALLEST_HALF)
        finished.append(pending.take(done))
        pending = pending.take(~done)
        if not len(pending) or count >= cells:
            break
        worst = pending.upper.topk(min(CHUNK // 2, len(pending))).indices
        rest = ~torch.isin(torch.arange(len(pending)), worst)
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
    return RigorousBound(bound, slack, (low, high), count, theta, complete=not len(pending))
