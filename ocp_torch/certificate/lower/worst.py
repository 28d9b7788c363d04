"""Batches in which the worst states of earlier ones come again, to train for a supremum."""

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

# Slacks in the mean of the largest, as a part of the number of new states: a pendulum's bound was 2.960 so, and 2.780
# without memory of earlier states.
TAIL = 1 / 16
# Worst states that come again at every step, as a part of the number of new ones: lower slacks may soon be the largest.
RETURNING = 1 / 4
# Part of the new states that `E[V mu0]` is a mean over: `V` is differentiated at these and the worst alone. All rounds on
# dubins took 126 s and gave 1.1497; with all new states 164 s and 1.1483, with a quarter of them 1.1434.
STARTED = 1 / 2
CLIMBERS = 64  # worst states that try a neighbour at every step: a pendulum's bound was 2.955 so, 2.945 without any
# The neighbours' random distances, from as narrow as spikes are.
NEAREST, FARTHEST = 1e-4, 1e-2

# Steps between searches for peaks in steep places, where no worst state leads: a unicycle's bound was 1.2996, without 1.2928.
SEEK_EVERY = 50
SOUGHT = 4  # random states of such a search, for each new state of a step
ASCENDING = 1 / 16  # part of these states from which ascents start


class WorstStates:
    """Draws for a `LevelledDual` of one `M`, with many states in the mean over the part `1 / M` of the torus.

    That takes `M` times as many states, more than a step can afford. But its gradient is that of the few with the largest
    slacks, and these hardly change from step to step: so each batch has new states, from ``draw``, and the worst of those
    that were new in the last `TAIL M` steps. Each is forgotten after as many steps, so that no spike can hide between states
    that stay; until then it climbs, which makes the mean a little too large. `E[V mu0]` is a mean over a part of the new
    states. Peaks that stand where the slack is low are sought now and then.
    """

    def __init__(self, problem: Problem, value: Field, draw: Callable[[], Samples], generator: torch.Generator) -> None:
        self.problem, self.value, self.draw, self.generator = problem, value, draw, generator
        self.steps = 0
        self.worst: Samples  # after the first step
        self.ages = torch.zeros(0)  # of the `worst`, in steps

    def __call__(self, phase: Phase) -> Samples:
        """New states and the worst of earlier ones; `penalty_weight` is 0 where the slack is not among the largest, of which
        the mean is taken."""
        new = self.draw()
        if self.steps % SEEK_EVERY == SEEK_EVERY - 1:
            self._seek(SOUGHT * len(new))
        batch, slack = self._climbed(new)
        ages = torch.cat([torch.zeros_like(new.weight), self.ages.to(new.weight) + 1.0])
        remembered = max(1, round(TAIL * phase.constants.M))  # steps
        self.steps += 1
        stand_for = min(self.steps, remembered) * len(new)
        worst = slack.topk(math.ceil(RETURNING * len(new))).indices
        again = worst[ages[worst] < remembered - 1]
        self.worst, self.ages = batch.take(again), ages[again]
        # Objectives divide by the size of the batch, but means are over the first states, and over all that it stands for.
        started = math.ceil(STARTED * len(new))
        is_start = torch.arange(len(batch), device=batch.x.device) < started
        weight = torch.where(is_start, len(batch) / started, 0.0).to(batch.x)
        judged = worst[: math.ceil(stand_for / phase.constants.M) + 1]
        penalty = torch.zeros_like(weight).index_fill_(0, judged, len(batch) / stand_for)
        return replace(batch, weight=weight, penalty_weight=penalty)

    def _seek(self, count: int) -> None:
        """Find peaks of the slack in steep places among ``count`` random states, and remember them."""
        x = torch.rand(count, self.problem.dim, generator=self.generator).to(self.worst.x)
        self.remember(peaks_in_reach(slack_function(self.problem, self.value), x, max(1, int(ASCENDING * count)))[0])

    def remember(self, peaks: Tensor) -> None:
        """Add the states ``peaks`` ``(K, d)`` to the worst."""
        if not len(peaks):  # a user's functions are not called with an empty batch
            return
        found = self.problem.samples(peaks.to(self.worst.x), divergences=False)
        self.worst = Samples.concatenate([self.worst, found])
        self.ages = torch.cat([self.ages, torch.zeros_like(found.weight)])

    def _climbed(self, new: Samples) -> tuple[Samples, Tensor]:
        """The ``new`` states and the worst ones, these moved to a neighbour where its slack is larger; and their slacks."""
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
