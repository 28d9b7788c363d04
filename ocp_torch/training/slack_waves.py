r"""Waves that `V` still lacks, found on the way in what is left of its slack.

Where `V` is close to `V*`, the slack `Q` is about linear in what is missing: a term `e^{2 pi i k . x}` that the embedding
does not have, and that was too small to be seen in the problem's data, is then the largest that `Q` is made of.
"""

import torch
from torch import Tensor

from ocp_torch.compute.processes import SingleProcess
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.fields.coupled_waves import coupled_waves, may_be_coupled
from ocp_torch.fields.embedding import FourierEmbedding
from ocp_torch.fields.waves import WAVE_STATES, standardised, waves_of
from ocp_torch.problems import Problem
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.training.state import TrainState

# Steps of a round after which missed waves are sought; the last time waves of many coordinates too, which takes seconds. In
# 32 coordinates F_M ended .026 % below OPT with searches, .174 % without.
WAVE_SEARCH_STEPS = (100, 200, 300)
# A slack below this part of the state cost's standard deviation is rounding in single precision.
ROUNDING = 1e-6


@torch.no_grad()
def missed_waves(problem: Problem, fields: Fields, coupled: bool = False) -> Tensor:
    """Wave vectors ``(W, d)`` that the slack of `V` has and its embedding lacks, at most as many as this has room for; with
    `coupled_waves` if ``coupled``."""
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


def seek_waves(problem: Problem, state: TrainState, done: int, ranks: SingleProcess) -> None:
    """Give all networks of ``state`` the waves that the slack shows to be missing, after those steps ``done`` of a round that
    `WAVE_SEARCH_STEPS` lists."""
    if done in WAVE_SEARCH_STEPS:
        averaged, last = state.average.module, done == WAVE_SEARCH_STEPS[-1]
        waves = ranks.from_first(lambda: missed_waves(problem, averaged, last))
        for fields in (state.fields, averaged):
            add_waves(fields, waves)
