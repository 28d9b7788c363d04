"""Batches with states that the controller in training visits."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import nn

from ocp_torch.errors import InputError
from ocp_torch.fields import VALUE, Fields, PeriodicMLP
from ocp_torch.maths.jets import jet
from ocp_torch.maths.sampling import UniformSampler
from ocp_torch.objectives import Dual, Phase, primal
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.training.batches import VISITED_PART, Batches
from support import zoo


class Sink(Problem):
    """All states drift to 0 unless they are controlled."""

    def __init__(self):
        super().__init__(dim=1, discount=1.0)

    def state_cost(self, x):
        return 1.0 - (zoo.TURN * x[:, 0]).cos()

    def drift(self, x):
        return -0.3 * (zoo.TURN * x).sin()


class Flat(nn.Module):
    """`V = c`, whose controller is 0."""

    def __init__(self, dtype=torch.float32):
        super().__init__()
        self.constant = nn.Parameter(torch.ones((), dtype=dtype))

    def forward(self, x):
        return self.constant + 0.0 * x.sum(dim=-1)


def build(problem, visited, size=1000, seed=0, constants=None, value=None, method=Dual):
    objective, phase = method(problem), Phase(constants or resolve_constants(problem))
    fields = Fields.build(problem, objective.fields, partial(PeriodicMLP, width=16), 0)
    if value is not None:
        fields.networks[VALUE] = value
    batches = Batches(problem, fields, objective, UniformSampler(problem.dim, seed, torch.float32), size, seed, visited)
    batches.next = partial(batches.draw, phase)
    return batches


def test_visited_states_settle_where_the_closed_loop_is():
    """`rho E int_0^inf e^{-rho t} cos(2 pi x_t) dt` from uniform starts, by small Euler steps; visitors take large ones."""
    problem = Sink()
    x, dt = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)[:-1, None], 1e-3
    expected = 0.0
    for k in range(12_000):
        expected += dt * math.exp(-(k + 0.5) * dt) * float((zoo.TURN * x).cos().mean())
        x = x + dt * problem.drift(x)
    assert expected > 0.3  # far from what uniform states give
    batches, found = build(problem, 0.5, value=Flat()), []
    for k in range(600):
        drawn = batches.next()
        if k >= 100:
            there = drawn.weight == 0.0
            stay = drawn.penalty_weight[there]
            found.append([float((stay * (zoo.TURN * drawn.x[there, 0]).cos()).sum()), float(stay.sum())])
    found = torch.tensor(found).sum(dim=0)
    assert float(found[0] / found[1]) == pytest.approx(expected, abs=0.03)


@pytest.mark.parametrize("visited", [0.0, 0.25, 0.8])
def test_integrals_are_those_of_the_uniform_states(visited):
    problem = zoo.build("arm n=2")
    batches = build(problem, visited, size=512)
    means = torch.stack([(s := batches.next()).mean(s.f) for _ in range(100)])
    assert len(s) == 512
    truth = float(problem.state_cost(zoo.states(problem, 2**14)).mean())
    assert abs(float(means.mean()) - truth) < 4.0 * float(means.std()) / 10.0 + 1e-3 * truth


def test_the_penalty_sees_the_visited_states_too():
    problem = zoo.build("arm n=2")
    constants = replace(resolve_constants(problem), unbounded=False, M=3.0)
    batches = build(problem, 0.25, size=400, constants=constants)
    batches.next()
    s = batches.next()
    assert int((s.weight == 0.0).sum()) == 100
    V = jet(batches.fields.value, s.x)
    slack = Generator.of(problem, s).hjb_slack(V)
    loss = Dual(problem, residual=0.0).losses(batches.fields, s, Phase(constants))["value"]
    assert bool((s.penalty_weight[:300] == 1.0).all())
    assert bool((s.penalty_weight > 0.0).all())
    expected = 3.0 * (s.penalty_weight * slack.clamp_min(0.0)).mean() - (V.value * s.mu0)[:300].mean()
    torch.testing.assert_close(loss, expected)


def test_states_are_visited_where_no_M_is_known_and_nowhere_else():
    of = lambda batches: int((batches.next().weight == 0.0).sum())
    assert of(build(zoo.build("arm n=2"), None)) == VISITED_PART * 1000
    assert of(build(zoo.build("arm n=2"), 0.0)) == 0
    assert of(build(zoo.build("arm n=2"), None, method=primal)) == 0
    assert of(build(Sink(), None)) == VISITED_PART * 1000
    assert build(zoo.build("circle rho=2"), None).next().penalty_weight is None


def test_batches_go_on_exactly_from_their_state():
    problem = zoo.build("arm n=2")
    batches = build(problem, 0.3)
    for _ in range(3):
        batches.next()
    state = batches.state_dict()
    expected = [batches.next().x for _ in range(3)]
    again = build(problem, 0.3, seed=5)
    again.load_state_dict(state)
    assert all(torch.equal(again.next().x, x) for x in expected)
    with pytest.raises(InputError, match="no states of 2 coordinates"):
        again.load_state_dict({**state, "states": torch.rand(7, 3)})


def test_a_visited_part_that_cannot_be_is_refused():
    problem = zoo.build("arm n=2")
    for visited in (-0.1, 1.0, "half"):
        with pytest.raises(InputError, match=r"sampler\.visited"):
            build(problem, visited)
    with pytest.raises(InputError, match="no V to follow"):
        build(problem, 0.5, method=primal)


def test_fields_that_give_no_velocity_do_not_lose_their_visitors():
    """A controller that is not finite somewhere sends nobody out of the torus."""
    problem = zoo.build("arm n=2")
    batches = build(problem, 0.5)
    with torch.no_grad():
        for p in batches.fields.value.parameters():
            p.mul_(1e30)
    for _ in range(3):
        assert bool(torch.isfinite(batches.next().x).all())
