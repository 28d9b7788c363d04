"""Batches in which the worst states of earlier ones come again: what a supremum is trained on."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.maths.jets import Field
from ocp_torch.maths.supremum import peaks_in_reach
from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# Parts of the number of new states: how many slacks the mean over the largest shall have, and how many of the worst are
# looked at again at every step, as those that were lower a few steps ago may be among the largest now. Bounds of a pendulum
# with limited torque for 40, 128 and 256 slacks at 2,048 new states: 2.955, 2.960, 2.969; without memory 2.780. A step on
# dubins with noise takes 60 ms so, 84 with twice as many of both, and 52 without memory.
TAIL, KEPT = 1 / 16, 1 / 4
# The part of the new states that `E[V mu0]` is a mean over, the only ones that `V` is differentiated at but the worst. With
# half of them all rounds on dubins took 126 s and gave 1.1497, with a quarter 1.1434, with all 164 s and 1.1483.
STARTED = 1 / 2
# How many of the worst look around at each step, and how far, at random between these radii: a spike is as narrow as that.
# That bound was 2.945 without any and 2.955 with them, for 40 slacks.
CLIMBERS, NEAREST, FARTHEST = 64, 1e-4, 1e-2

# Every so many steps peaks are sought in steep places as well, where no worst state leads: among so many times as many states
# as a step has new ones, by ascents from that part of these. Less what other states showed later, the bound of a unicycle was
# 1.2928 without and 1.2996 with it, that of a pendulum with limited torque 2.9967 and 2.9970.
SEEK_EVERY, SOUGHT, STARTS = 50, 4, 1 / 16


class WorstStates:
    """Draws for a `LevelledDual` of one `M`, whose mean over the part `1 / M` of the torus has many states.

    That takes `M` times as many, more than a step can afford. But its gradient is that of the few with the largest slacks,
    and these hardly change from step to step: so each batch has new states, from ``draw``, and with them the worst of those
    that were new in the last `TAIL M` steps. Each is forgotten after so many steps, so that no spike can hide between states
    that stay; until then it climbs, which makes the mean a little too large. `E[V mu0]` is a mean over some of the new ones.
    Peaks that stand where the slack is low are sought now and then.
    """

    def __init__(self, problem: Problem, value: Field, draw: Callable[[], Samples], generator: torch.Generator) -> None:
        self.problem, self.value, self.draw, self.generator = problem, value, draw, generator
        self.steps = 0
        self.worst: Samples  # after the first step
        self.ages = torch.zeros(0)  # of the `worst`, in steps

    def __call__(self, phase: Phase) -> Samples:
        """New states, and the worst of the last ones; `penalty_weight` is 0 for those that are not among the largest slacks
        of which the mean is."""
        new = self.draw()
        if self.steps % SEEK_EVERY == SEEK_EVERY - 1:
            self._seek(SOUGHT * len(new))
        batch, slack = self._climbed(new)
        ages = torch.cat([torch.zeros_like(new.weight), self.ages.to(new.weight) + 1.0])
        remembered = max(1, round(TAIL * phase.constants.M))  # steps
        self.steps += 1
        stand_for = min(self.steps, remembered) * len(new)
        worst = slack.topk(math.ceil(KEPT * len(new))).indices
        again = worst[ages[worst] < remembered - 1]
        self.worst, self.ages = batch.take(again), ages[again]
        # Objectives divide by the size of the batch: means are over the first states, and over all that the worst are of.
        started = math.ceil(STARTED * len(new))
        is_start = torch.arange(len(batch), device=batch.x.device) < started
        weight = torch.where(is_start, len(batch) / started, 0.0).to(batch.x)
        judged = worst[: math.ceil(stand_for / phase.constants.M) + 1]
        penalty = torch.zeros_like(weight).index_fill_(0, judged, len(batch) / stand_for)
        return replace(batch, weight=weight, penalty_weight=penalty)

    def _seek(self, count: int) -> None:
        """Peaks of the slack in steep places of ``count`` states are among the worst from now on."""
        x = torch.rand(count, self.problem.dim, generator=self.generator).to(self.worst.x)
        self.remember(peaks_in_reach(slack_function(self.problem, self.value), x, max(1, int(STARTS * count)))[0])

    def remember(self, peaks: Tensor) -> None:
        """The states ``peaks`` ``(K, d)`` are among the worst from now on."""
        if not len(peaks):  # nobody's functions are asked for no state
            return
        found = self.problem.samples(peaks.to(self.worst.x), divergences=False)
        self.worst = Samples.concatenate([self.worst, found])
        self.ages = torch.cat([self.ages, torch.zeros_like(found.weight)])

    def _climbed(self, new: Samples) -> tuple[Samples, Tensor]:
        """The ``new`` states and the worst ones, where these moved to if a neighbour's slack is larger; and their slacks."""
        if self.steps == 0:
            return new, self._slack(new)
        climbers = self.worst.x[:CLIMBERS]
        radius = NEAREST * (FARTHEST / NEAREST) ** torch.rand(len(climbers), 1, generator=self.generator)
        step = radius * torch.randn(climbers.shape, generator=self.generator)
        neighbours = self.problem.samples((climbers + step.to(climbers)).remainder(1.0), divergences=False)
        batch = Samples.concatenate([new, self.worst, neighbours])
        slack = self._slack(batch)
        numbers = torch.arange(len(batch), device=slack.device)
        here, there = numbers[len(new) :][: len(climbers)], numbers[len(new) + len(self.worst) :]
        rows = numbers[: len(new) + len(self.worst)].clone()
        rows[here] = torch.where(slack[there] > slack[here], there, here)
        return batch.take(rows), slack[rows]

    @torch.no_grad()
    def _slack(self, samples: Samples) -> Tensor:
        generator = Generator.of(self.problem, samples)
        return generator.hjb_slack(generator.chunked_jet(self.value))
