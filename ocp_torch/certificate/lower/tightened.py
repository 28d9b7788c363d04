r"""`V` trained on for the shifted bound alone.

Training fits the slack on average, for a good controller; here its largest values count. A copy of `V` goes on from where
training left it, by the `LevelledDual`, on batches in which the worst states come again (`WorstStates`): what comes out is
kept for the bound alone, which holds for any `W` and is measured on other states. Its slack has fewer high narrow
peaks, so that the supremum is found more surely: on two independent sets of 131,072 states the bounds of an arm's `V`
differed by 0.8 %, of `W` by 0.02 %. Those that are left stand in hollows, where ascents from the largest values do not lead:
they hid up to 0.3 % of a bound. So peaks are sought in steep places too, in training and by the bound (`steep_peaks`): of
six `W` in two and three coordinates eight more searches, of other states, then took at most 0.001 % off their bounds; of
two in five, of six oscillators, 0.6 % off one and nothing off the other.
"""

import copy
from collections.abc import Iterator

import torch
from torch import nn

from ocp_torch.certificate.lower.worst import WorstStates
from ocp_torch.fields.fields import VALUE, Fields, cost_unit
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives.levelled import LevelledDual
from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.steppers import advance, short_fit
from ocp_torch.steppers.nonfinite import NonFiniteError

# Of each round `M`, steps, and the first learning rate, which falls to 0: the slack's mean over the part `1 / M` of the torus
# stands for its supremum. With noise kinks are rounded, and a step takes twice as long. Bounds less all peaks that were found
# later, and seconds of one core: by rounds of M = 100, 1,000, 3,000 and 3,000 of 300, 600, 1,200 and 2,400 steps at 1e-3,
# the usual memory and no search for peaks, and by these: two unicycles 1.3001 (116) and 1.2996 (71), 1.2917 (141) and 1.2960
# (74), a pendulum with limited torque 2.9703 (61) and 2.9970 (71), an arm .4605 (34) and .4606 (72).
ROUNDS, NOISY_ROUNDS = ((1000.0, 600, 5e-3), (3000.0, 1400, 3e-3)), ((3000.0, 700, 2e-3),)
# Memory of the optimiser's moments, below the usual (.95, .95): with that, at 1e-3, one `V` of a unicycle came to 1.2959 by
# 2,100 steps and to 1.2986 by 4,500, with this, at 5e-3, to 1.2985 by 2,000 (mean over the part 1 / 3000), as with (.8, .95).
BETAS = (0.9, 0.95)
BATCH = 2048  # new states of a step, at most


def rounds_of(problem: Problem) -> tuple[tuple[float, int, float], ...]:
    """`ROUNDS`, or those with noise."""
    return NOISY_ROUNDS if problem.noisy else ROUNDS


def new_states(problem: Problem, batch: int) -> int:
    """How many states `tightened` draws with up to ``batch`` a step, the worst that come again aside."""
    states = min(batch, BATCH)
    return sum(whole * states // BATCH for _, whole, _ in rounds_of(problem)) * states


def tightened(problem: Problem, value: Field, seed: int, batch: int = BATCH) -> Iterator[Subsolution | None]:
    """`W` for ``value`` `V`, in float64, after each round of training in float32 on up to ``batch`` states a step, and `None`
    after each step; nothing where `V` has no weights, nothing more where these do not stay finite. Fewer states than `BATCH`
    are for a quick evaluation, with as many times fewer steps."""
    if not isinstance(value, nn.Module) or not any(True for _ in value.parameters()):
        return
    objective, unit = LevelledDual(problem), cost_unit(problem)
    fields = Fields({VALUE: copy.deepcopy(value).float().requires_grad_(True)})
    sampler = SobolSampler(problem.dim, derive_seed(seed, Branch.TIGHTENING), torch.float32)
    states = min(batch, BATCH)
    new = lambda: problem.samples(sampler.draw(states), divergences=False)
    for k, (M, whole, rate) in enumerate(rounds_of(problem)):
        steps = max(1, whole * states // BATCH)
        stepper, average = short_fit(fields, objective, rate, steps, unit, betas=BETAS)
        phase = Phase(Constants(M=M, C_V=1.0, C_u=1.0, sources={}))
        generator = torch.Generator().manual_seed(derive_seed(seed, Branch.TIGHTENING, k))
        draw = WorstStates(problem, fields.value, new, generator)
        try:
            for _ in range(steps):
                with torch.enable_grad():
                    advance(stepper, average, draw, phase)
                yield None
        except NonFiniteError:
            return
        fields.load_state_dict(average.module.state_dict())
        yield Subsolution(copy.deepcopy(fields.value), draw.worst.x).requires_grad_(False).double()
