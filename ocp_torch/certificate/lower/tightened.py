r"""`V` trained on for the shifted bound alone.

Training fits the slack on average, for a good controller; here its largest values count. A copy of `V` goes on from where
training left it, by the `LevelledDual`, on batches in which the worst states come again (`WorstStates`): what comes out is
handed to nobody but the bound, which holds for any `W` and is measured on other states. Its slack has fewer high narrow
spikes, so that the supremum is found more surely: on two independent sets of 131,072 states the bounds of an arm's `V`
differed by 0.8 %, of `W` by 0.02 %. But some are left, and well hidden: 1,048,576 states and 256 ascents took 0.3 % off the
bound of a pendulum with limited torque, 0.08 % off a unicycle's. Higher rates, less memory and half of the steps hid 0.5 % of
the latter. So the states that training found worst are handed on too.
"""

import copy
from collections.abc import Iterator

import torch
from torch import nn

from ocp_torch.certificate.lower.worst import WorstStates
from ocp_torch.fields.fields import VALUE, Fields, cost_unit
from ocp_torch.maths.jets import Field
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives.levelled import LevelledDual
from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers import advance, short_fit
from ocp_torch.steppers.nonfinite import NonFiniteError

# `M` and steps of each round: the slack's mean over the part `1 / M` of the torus stands for its supremum. The bound of a
# pendulum with limited torque ends the third at 2.962; at 2.931 by 1,000, 3,000 and 10,000, at 2.780 by 100 alone. Bounds at
# first and after each round: that pendulum 2.761, 2.760, 2.904, 2.967, 2.990 in 170 s, and 2.961 at a rate of 2e-3 with a
# third fewer steps; an arm .4475, .4594, .4597, .4603.
ROUNDS = ((100.0, 300), (1000.0, 600), (3000.0, 1200), (3000.0, 2400))
# With noise, which rounds the kinks, and where a step takes twice as long. It gave two dubins 1.1772 and 1.1758 for 1.0949
# and 1.1553, a unicycle 1.3084 for 1.2934; 200 steps at 100 and then 1,200 at 3,000 gave the dubins 1.1713 and 1.1718; 200,
# 400, and 800 steps at 100, 1,000 and 3,000 the second one 1.1753. Another 2,800 steps would take a third of a run's time.
NOISY_ROUNDS = ((3000.0, 1400),)
# New states of a step, at most, and the first learning rate of each round.
BATCH, RATE = 2048, 1e-3


def tightened(problem: Problem, value: Field, seed: int, batch: int = BATCH) -> Iterator[tuple[Field, Samples] | None]:
    """`W` for ``value`` `V`, and states where its slack is largest, both in float64, after each round of training in float32
    on up to ``batch`` states a step, and `None` after each step; nothing where `V` has no weights, nothing more where these
    do not stay finite. Fewer states than `BATCH` are for a quick certificate, with as many times fewer steps."""
    if not isinstance(value, nn.Module) or not any(True for _ in value.parameters()):
        return
    objective, unit = LevelledDual(problem), cost_unit(problem)
    fields = Fields({VALUE: copy.deepcopy(value).float().requires_grad_(True)})
    sampler = SobolSampler(problem.dim, derive_seed(seed, Branch.TIGHTENING), torch.float32)
    states = min(batch, BATCH)
    new = lambda: problem.samples(sampler.draw(states), divergences=False)
    for k, (M, whole) in enumerate(NOISY_ROUNDS if problem.noisy else ROUNDS):
        steps = max(1, whole * states // BATCH)
        stepper, average = short_fit(fields, objective, RATE, steps, unit)
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
        W = copy.deepcopy(fields.value).requires_grad_(False).double()
        yield W, problem.samples(draw.worst.x.double(), divergences=False)
