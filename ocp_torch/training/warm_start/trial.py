"""What a controller costs, quickly: one and the same trial for all that come along, by which the best of them is kept."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.control.pace import Pace
from ocp_torch.maths.jets import Field
from ocp_torch.problems import Problem
from ocp_torch.training.warm_start.pieces import lambda_returns, roll

TRIAL_STARTS = 256
TRIAL_TIME = 6.0  # in units of 1 / rho


@dataclass(frozen=True)
class Trial:
    """Trials from ``starts`` ``(N, d)``, drawn from `mu0`, at ``pace``; ``seed`` gives the noise, the same in each trial."""

    problem: Problem
    pace: Pace
    starts: Tensor
    seed: int

    def cost_of(self, value: Field) -> float:
        """The mean discounted cost of the controller of ``value``; infinity where it is not finite. An estimate, by which no
        bound is made: controls are held in each step, and the running cost is taken to stay what it is at the end."""
        steps = math.ceil(TRIAL_TIME / (self.problem.discount * self.pace.step))
        noise = torch.Generator().manual_seed(self.seed)
        ran = roll(self.problem, value, self.starts, self.pace, steps, noise)
        rest = torch.cat([torch.zeros_like(ran.costs), ran.last.unsqueeze(0)])
        cost = float(lambda_returns(ran.costs, rest, self.problem.discount, self.pace.step, 1.0)[0].mean())
        return cost if math.isfinite(cost) else math.inf

    def cost_of_nothing(self) -> float:
        """The mean discounted cost without control."""
        return self.cost_of(lambda x: 0.0 * x.sum(dim=-1))
