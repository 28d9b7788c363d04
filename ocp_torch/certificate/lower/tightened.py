r"""`V` trained on for the shifted bound.

Training fits the slack on average, for a good controller; here its largest values count. A copy `W` of `V` is trained on by
the `LevelledDual`, on batches in which the worst states come again (`WorstStates`), and kept beside `V` for the bound, which
holds for any `W` and is measured on other states. The slack of `W` has fewer high narrow peaks, so that its supremum is
found more surely: on two independent sets of 131,072 states the bounds of an arm's `V` differed by 0.8 %, of `W` by 0.02 %.
The peaks that are left stand in hollows, out of reach of ascents from the largest values, and hid up to 0.3 % of a bound: in
training and by the bound they are sought in steep places too (`steep_peaks`). Eight more searches then took at most 0.001 %
off the bounds of six `W` in two and three coordinates, but 0.6 % off one of two in five.
"""

import copy

import torch
from torch import Tensor, nn

from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.certificate.lower.worst import WorstStates
from ocp_torch.fields.fields import VALUE, Fields, cost_unit
from ocp_torch.fields.rounded import rounded
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field
from ocp_torch.maths.peaks import STEEP_ASCENTS, steep_peaks
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives.levelled import LevelledDual
from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.steppers import advance, short_fit
from ocp_torch.steppers.nonfinite import NonFiniteError

# `M`, steps, and the first learning rate, which falls to 0. The slack's mean over the part `1 / M` of the torus stands for
# its supremum: a pendulum's bound was 3.0311, in as long 3.0278 by 600 steps of M = 1,000 and 1,400 of 3,000.
PLAN = (3000.0, 2000, 5e-3)
NOISY_PLAN = (3000.0, 700, 2e-3)  # with noise, which rounds kinks and makes a step take twice as long
# Decays of the optimiser's moments: a unicycle's bound came to 1.2985 by 2,000 steps at a rate of 5e-3; by the usual
# (.95, .95) at 1e-3 to 1.2959 by 2,100 and to 1.2986 by 4,500.
BETAS = (0.9, 0.95)
BATCH = 2048  # new states of a step, at most
# When the steps divided by this are left, peaks are sought as the bound will seek them, and mended in these last steps: of
# three unicycles with noise one had kept a peak that took 2.1 % off its bound.
LAST_DIVISOR = 7
# Ascents from the largest values that the bound is taken to make, by which that search is as long as the bound's.
ASCENTS = 32


def plan_of(problem: Problem, steps: int | None) -> tuple[float, int, float]:
    """`M`, steps and learning rate for ``problem``: `PLAN` or `NOISY_PLAN`, with ``steps`` where they are given."""
    M, usual, rate = NOISY_PLAN if problem.noisy else PLAN
    return M, usual if steps is None else steps, rate


def batches_of(problem: Problem, batch: int, steps: int | None) -> tuple[int, int]:
    """The steps of `tightened` and the new states of each, where ``batch`` are the most; the worst come again beside them."""
    whole, states = plan_of(problem, steps)[1], min(batch, BATCH)
    return max(min(whole, 1), whole * states // BATCH), states


def tightened(
    problem: Problem, value: Field, seed: int, batch: int = BATCH, steps: int | None = None
) -> Subsolution | None:
    """Train `W` from ``value`` `V` in float32 by ``steps`` on up to ``batch`` new states each.

    Returns `W` in float64; `None` where `V` has no weights, there are no steps, or weights do not stay finite. Fewer states
    than `BATCH` are for a quick evaluation, and take as many times fewer steps."""
    M, whole, rate = plan_of(problem, steps)
    if not whole or not isinstance(value, nn.Module) or not any(True for _ in value.parameters()):
        return None
    objective, unit = LevelledDual(problem), cost_unit(problem)
    fields = Fields({VALUE: copy.deepcopy(value).float().requires_grad_(True)})
    sampler = SobolSampler(problem.dim, derive_seed(seed, Branch.TIGHTENING), torch.float32)
    count, states = batches_of(problem, batch, steps)
    stepper, average = short_fit(fields, objective, rate, count, unit, betas=BETAS)
    phase = Phase(Constants(M=M, C_V=1.0, C_u=1.0, sources={}))
    new = lambda: problem.samples(sampler.draw(states), divergences=False)
    generator = torch.Generator().manual_seed(derive_seed(seed, Branch.TIGHTENING, 0))
    draw = WorstStates(problem, fields.value, new, generator)
    try:
        for step in range(count):
            if step == count - count // LAST_DIVISOR:
                starts = STEEP_ASCENTS * ASCENTS * states // BATCH
                draw.remember(hidden_peaks(problem, average.module.value, draw.worst.x, starts, generator))
            with torch.enable_grad():
                advance(stepper, average, draw, phase)
    except NonFiniteError:
        return None
    return Subsolution(average.module.value, draw.worst.x).requires_grad_(False).double()


@torch.no_grad()
def hidden_peaks(
    problem: Problem, network: nn.Module, worst: Tensor, starts: int, generator: torch.Generator
) -> Tensor:
    """Peaks ``(K, d)`` of the slack of ``network`` in steep places, by ``starts`` ascents in each search, where it may be
    higher than at the ``worst`` states known."""
    W = copy.deepcopy(network).double()
    slack, rough = slack_function(problem, W), slack_function(problem, rounded(W))
    known = float(slack(worst.double()).max()) if len(worst) else 0.0
    return steep_peaks(slack, rough, problem.dim, starts, known, cost_unit(problem), generator).x
