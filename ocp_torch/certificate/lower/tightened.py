r"""`V` trained on for the shifted bound alone.

Training fits the slack on average, for a good controller; here its largest values count. A copy of `V` goes on from where
training left it, by the `LevelledDual`: what comes out is handed to nobody but the bound, which holds for any `W` and is
measured on other states.
"""

import copy

import torch
from torch import nn

from ocp_torch.fields.fields import VALUE, Fields, cost_unit
from ocp_torch.maths.jets import Field
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives.levelled import LevelledDual
from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.steppers import advance, short_fit
from ocp_torch.steppers.nonfinite import NonFiniteError

# The slack's mean over a hundredth of the torus stands for its supremum. Over a thirtieth a pendulum with limited torque had
# no bound in the end; over a thousandth others have a lower one.
PHASE = Phase(Constants(M=100.0, C_V=1.0, C_u=1.0, sources={}))
# States of a step, steps of the first round, each further one twice as long, and the first learning rate of each. A larger
# one forgets what `V` knows, which pays only where the bound is far off: another round follows where the last one gained
# that part of it (gap of a pendulum with limited torque: 61 % before, 24 % after one round, 16 % after three; of dubins with
# noise 2.1 %, 1.6 %).
BATCH, STEPS, RATES, WORTH = 2048, 300, (5e-4, 2e-3, 2e-3), 0.02
# States on which that is measured.
MEASURED = 2**14


def tightened(problem: Problem, value: Field, seed: int) -> Field | None:
    """`W` for ``value`` `V` in float64, trained in float32; `None` where that has no weights, or does not stay finite."""
    if not isinstance(value, nn.Module) or not any(True for _ in value.parameters()):
        return None
    objective, unit = LevelledDual(problem), cost_unit(problem)
    fields = Fields({VALUE: copy.deepcopy(value).float().requires_grad_(True)})
    sampler = SobolSampler(problem.dim, derive_seed(seed, Branch.TIGHTENING), torch.float32)
    draw = lambda count: problem.samples(sampler.draw(count), divergences=False)
    measured = draw(MEASURED)
    lost = lambda: float(objective.losses(fields, measured, PHASE)[VALUE].detach())
    before = lost()
    for k, rate in enumerate(RATES):
        stepper, average = short_fit(fields, objective, rate, STEPS * 2**k, unit)
        try:
            for _ in range(STEPS * 2**k):
                advance(stepper, average, lambda _: draw(BATCH), PHASE)
        except NonFiniteError:
            return None
        fields.load_state_dict(average.module.state_dict())
        before, gained = lost(), before - lost()
        if not gained > WORTH * abs(before):
            break
    return fields.value.requires_grad_(False).double()
