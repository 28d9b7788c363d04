"""Batches in which the worst states of earlier ones come again."""

import pytest
import torch

from ocp_torch.certificate.lower.tightened import hidden_peaks, tightened
from ocp_torch.certificate.lower.worst import WorstStates
from ocp_torch.fields import PeriodicMLP
from ocp_torch.fields.fields import VALUE, Fields
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.objectives.levelled import LevelledDual
from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo
from support.hidden_peak import HILLS, PLACE, Still, hidden_peak, top

NEW = 64


def phase_of(M: float) -> Phase:
    return Phase(Constants(M=M, C_V=1.0, C_u=1.0, sources={}))


def batches(problem, count: int) -> list[Samples]:
    return [Samples.of(problem, x, divergences=False) for x in zoo.states(problem, count * NEW).split(NEW)]


@pytest.mark.parametrize("name", ["noisy 2-d sigma(x)", "box-limited 2-d"])
@pytest.mark.parametrize("M", [3.0, 6.4])
def test_a_batch_stands_for_all_states_of_the_last_ones(name, M, monkeypatch):
    """The level and the mean above it are those of all of them, `E[V mu0]` is that of half of the new ones."""
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.CLIMBERS", 0)
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.TAIL", 40 / NEW)
    problem = zoo.build(name)
    value = zoo.rough_network(2, seed=3)
    given = batches(problem, 9)
    remembered = round(40 * M / NEW)
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.RETURNING", 60 / NEW)  # above the level are 40
    draw = WorstStates(problem, value, iter(given).__next__, fixed_generator())
    objective, phase = LevelledDual(problem), phase_of(M)
    for k, new in enumerate(given):
        batch = draw(phase)
        assert len(batch) < NEW + 60 + 1
        found = objective.losses(Fields({VALUE: value}), batch, phase)[VALUE]
        union = Samples.concatenate(given[max(0, k + 1 - remembered) : k + 1])
        generator = Generator.of(problem, union)
        slack = generator.hjb_slack(generator.chunked_jet(value))
        # The least of `c + M E[max(Q - c, 0)]` over all `c` is at one of the slacks (Rockafellar and Uryasev).
        tail = min(float(c + M * (slack - c).clamp_min(0.0).mean()) for c in slack)
        start = new.take(slice(NEW // 2))
        paid = float((value(start.x) * start.mu0).mean().detach())
        assert float(found.detach()) == pytest.approx(tail - paid, rel=1e-9)


def test_no_state_stays_longer_than_the_others_it_is_compared_with(monkeypatch):
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.TAIL", 40 / NEW)
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.CLIMBERS", 0)
    problem = zoo.build("box-limited 2-d")
    given = batches(problem, 12)
    draw = WorstStates(problem, zoo.rough_network(2, seed=3), iter(given).__next__, fixed_generator())
    for k in range(12):
        x = draw(phase_of(6.4)).x  # of four batches
        for past, old in enumerate(given[: k + 1]):
            met = (x.unsqueeze(1) == old.x).all(dim=-1).any()
            assert bool(met) == (k - past < 4)


def test_the_worst_are_those_of_the_value_as_it_is_now(monkeypatch):
    """A spike that `V` has lost is not trained on, though its states are still remembered."""
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.CLIMBERS", 0)
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.RETURNING", 30 / NEW)
    problem, height = zoo.build("box-limited 2-d"), torch.ones((), dtype=torch.float64)
    bump = lambda x: height * torch.exp(2.0 * torch.cos(2.0 * torch.pi * x).sum(dim=-1))
    draw = WorstStates(problem, bump, iter(batches(problem, 2)).__next__, fixed_generator())
    draw(phase_of(100.0))
    height.fill_(-1.0)
    batch = draw(phase_of(100.0))
    generator = Generator.of(problem, batch)
    slack, judged = generator.hjb_slack(generator.chunked_jet(bump)), batch.penalty_weight > 0.0
    assert len(batch) == NEW + 30
    assert int(judged.sum()) == 3  # the mean is over 1.28 of 128
    assert slack[judged].min() >= slack[~judged].max()


def test_the_worst_states_climb_to_the_top_of_a_narrow_spike():
    """A bump of radius .02 in a plane; a state near its top is met once, and 64 more at every step hardly help."""
    problem = zoo.build("box-limited 2-d")
    centre = torch.tensor([0.37, 0.61], dtype=torch.float64)
    distance = lambda x: (2.0 * torch.sin(torch.pi * (x - centre))).square().sum(dim=-1) / (2.0 * torch.pi) ** 2
    spike = lambda x: torch.exp(-distance(x) / (2.0 * 0.02**2))
    points = zoo.states(problem, 100 * NEW)
    near = (points - centre).norm(dim=-1).topk(NEW, largest=False).indices
    given = [Samples.of(problem, x, divergences=False) for x in (points[near], *points.split(NEW))]
    draw = WorstStates(problem, spike, iter(given).__next__, fixed_generator())
    top = []
    for _ in range(60):
        batch = draw(phase_of(1000.0))
        generator = Generator.of(problem, batch)
        top.append(float(generator.hjb_slack(generator.chunked_jet(spike)).max()))
    fine = Samples.of(problem, centre + 0.06 * (zoo.states(problem, 40_000) - 0.5), divergences=False)
    generator = Generator.of(problem, fine)
    truth = float(generator.hjb_slack(generator.chunked_jet(spike)).max())
    assert top == sorted(top)
    assert top[-1] > truth - 0.1 * (truth - top[0])


@pytest.mark.parametrize("every", [2, 1000])
def test_peaks_in_hollows_are_sought_now_and_then(every, monkeypatch):
    monkeypatch.setattr("ocp_torch.certificate.lower.worst.SEEK_EVERY", every)
    problem = Still()
    value = lambda x: problem.state_cost(x) + hidden_peak(x)
    given = [Samples.of(problem, x, divergences=False) for x in zoo.states(problem, 16 * 2048).split(2048)]
    draw, largest = WorstStates(problem, value, iter(given).__next__, fixed_generator()), []
    for _ in given:
        batch = draw(phase_of(1000.0))
        largest.append(float((value(batch.x) - batch.f)[batch.penalty_weight > 0.0].max()))
    assert largest[0] < 1.001 * HILLS
    assert (max(largest) > 0.99 * top()) == (every == 2)
    assert (max(largest) < 1.001 * HILLS) == (every == 1000)


class Peaked(torch.nn.Module):
    """The cost and the peak, as a network is called."""

    def forward(self, x):
        return Still().state_cost(x) + hidden_peak(x)


def test_peaks_that_training_has_not_met_are_sought_before_it_ends_and_are_among_the_worst_then(monkeypatch):
    problem, place = Still(), torch.tensor([PLACE])
    peaks = hidden_peaks(problem, Peaked(), place + 0.3, 512, fixed_generator(1))
    assert bool(((peaks - place).abs() < 1e-3).all(dim=1).any())

    value = PeriodicMLP(2, width=8, depth=1)
    sought, found = [], torch.tensor([[0.125, 0.875]], dtype=torch.float64)
    remembered = lambda *how: sought.append(how[3]) or found
    monkeypatch.setattr(f"{tightened.__module__}.hidden_peaks", remembered)
    monkeypatch.setattr(f"{tightened.__module__}.PLAN", (40.0, 14, 1e-3))
    seen = []
    taken = WorstStates.remember
    monkeypatch.setattr(WorstStates, "remember", lambda draw, x: (taken(draw, x), seen.append(draw.worst.x[-1])))
    tightened(problem, value, 0)
    assert sought == [2048]
    assert torch.equal(seen[-1], found[0].float())


def test_where_no_peak_is_found_no_function_is_asked_for_no_state():
    class Careful(Still):
        def state_cost(self, x):
            assert len(x)
            return super().state_cost(x)

    problem = Careful()
    given = batches(problem, 2)
    draw = WorstStates(problem, zoo.rough_network(2, seed=3), iter(given).__next__, fixed_generator())
    draw(phase_of(4.0))
    before = draw.worst
    draw.remember(torch.zeros(0, 2))
    assert draw.worst is before
