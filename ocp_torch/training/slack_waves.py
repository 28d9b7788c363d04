r"""Waves that `V` still lacks, found on the way in what is left of its slack.

Where `V` is close to `V*`, the slack `Q` is about linear in what is missing: a term `e^{2 pi i k . x}` that the embedding
does not have, and that was too small to be seen in the problem's data, is then the largest that `Q` is made of.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.fields.coupled_waves import coupled_waves, may_be_coupled
from ocp_torch.fields.embedding import FourierEmbedding
from ocp_torch.fields.waves import WAVE_STATES, standardised, waves_of
from ocp_torch.problems import Problem
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples

if TYPE_CHECKING:
    from ocp_torch.training.trainer import Trainer

# Steps of a round after which they are sought. With 32 coordinates one of 64 terms is missing at first, with 64 coordinates
# 18 of 127; all are found after 200 steps, and F_M ends .026 and .021 % below OPT after 600 (with 32 .174 % without), on a
# torus in three dimensions, with kinks, .041 for .074 %. Sought after 100 steps too, F_M is .109 % below OPT in 64 dimensions
# after 165, and 1.06 % if not; a torus and eight coordinates end the same. The last time, which comes where no
# Gauss-Newton steps have ended training, takes seconds: waves of many coordinates too.
SOUGHT_AT = (100, 200, 300)
# A slack below so much of the state cost's standard deviation is rounding in single precision.
ROUNDING = 1e-6


@torch.no_grad()
def missed_waves(problem: Problem, fields: Fields, coupled: bool = False) -> Tensor:
    """Wave vectors ``(W, d)`` that the slack of `V` has and its embedding has not, at most as many as that has room for; with
    `coupled_waves`, if they are asked for."""
    embedding = getattr(fields.value, "embedding", None)
    if not isinstance(embedding, FourierEmbedding) or not embedding.free:
        return torch.zeros(0, problem.dim)
    room = len(embedding.free)
    samples = problem.independent_samples(WAVE_STATES).to(next(fields.parameters()))
    generator = Generator.of(problem, samples)
    slack = generator.hjb_slack(generator.chunked_jet(fields.value)) * samples.weight
    if slack.square().mean().sqrt() < ROUNDING * samples.f.std():
        return torch.zeros(0, problem.dim)
    known = embedding.waves(problem.dim).cpu()
    found = waves_of(samples.x.cpu(), standardised(slack.cpu()), room + len(known))
    new = [wave for wave in found if not (wave == known).all(dim=-1).any()]
    missed = torch.stack(new[:room]) if new else found[:0]
    if not coupled or len(missed) == room or not may_be_coupled(problem):
        return missed

    def slack_at(x: Tensor) -> Tensor:
        there = Generator.of(problem, Samples.live(problem, x.to(samples.x)))
        return there.hjb_slack(there.chunked_jet(fields.value)).float().cpu()

    more = coupled_waves(slack_at, samples.x.float().cpu(), torch.cat([known, missed]), room - len(missed))
    return torch.cat([missed, more])


def add_waves(fields: Fields, waves: Tensor) -> None:
    """Give ``waves`` to each network of ``fields`` that can take them."""
    for network in fields.networks.values():
        if isinstance(network, PeriodicMLP):
            network.add_waves(waves)


def seek_waves(trainer: "Trainer") -> None:
    """Before some steps of a round: take what is missed."""
    done = trainer.step - trainer.settings.start(trainer.state.round)
    if done in SOUGHT_AT:
        last = done == SOUGHT_AT[-1]
        waves = trainer.ranks.from_first(lambda: missed_waves(trainer.problem, trainer.averaged_fields, last))
        for fields in (trainer.fields, trainer.averaged_fields):
            add_waves(fields, waves)
