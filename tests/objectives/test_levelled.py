"""D(M) with the best constant in `V`."""

import pytest
import torch

from ocp_torch.fields.fields import VALUE, Fields
from ocp_torch.objectives.levelled import LevelledDual
from ocp_torch.objectives.objective import Phase
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo


def loss(problem, value, x, M):
    constants = Constants(M=M, C_V=1.0, C_u=1.0, sources={})
    samples = Samples.of(problem, x, divergences=False)
    return LevelledDual(problem).losses(Fields({VALUE: value}), samples, Phase(constants))[VALUE]


@pytest.mark.parametrize("M", [1.0, 3.0, 17.5, 200.0])
def test_the_loss_is_minus_the_bound_of_the_best_constant(M):
    problem = zoo.build("noisy 2-d sigma(x)")
    value, x = zoo.rough_network(2, seed=1), zoo.states(problem, 200)
    generator = Generator.of(problem, Samples.of(problem, x, divergences=False))
    V = generator.jet(value)
    slack, gained = generator.hjb_slack(V), float((V.value * generator.data.mu0).mean())
    # F_M(V - c) is piecewise linear in c, with corners at the slacks.
    bounds = [gained - c - M * float((slack - c).clamp_min(0.0).mean()) for c in slack.tolist()]
    assert float(loss(problem, value, x, M).detach()) == pytest.approx(-max(bounds), rel=1e-12)
    if M == 200.0:  # as many as there are states: the largest slack alone counts
        assert max(bounds) == pytest.approx(gained - float(slack.max()), rel=1e-12)


def test_a_constant_in_the_value_does_not_matter_to_loss_and_gradient():
    problem = zoo.build("box-limited 2-d")
    value, x = zoo.rough_network(2, seed=2).requires_grad_(True), zoo.states(problem, 300)
    found = []
    for _ in range(2):
        of = loss(problem, value, x, 20.0)
        found.append([of.detach(), *torch.autograd.grad(of, list(value.parameters()), materialize_grads=True)])
        with torch.no_grad():
            value.head.bias += 3.0
    for here, there in zip(*found, strict=True):
        torch.testing.assert_close(here, there, rtol=1e-9, atol=1e-9)


def test_a_slack_that_is_no_number_makes_a_loss_that_is_none():
    """However few they are: it is no smallest of the slacks."""
    problem = zoo.build("box-limited 2-d")
    x, value = zoo.states(problem, 300), zoo.rough_network(2, seed=2)
    state_cost = problem.state_cost
    holed = lambda y: state_cost(y).masked_fill((y == x[7]).all(dim=-1), float("nan"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problem, "state_cost", holed)
        assert loss(problem, value, x, 20.0).isnan()


@pytest.mark.parametrize("M", [1.0, 7.3, 20.0, 300.0])
def test_a_constant_in_the_value_has_no_gradient(M):
    problem = zoo.build("limited 2-d")
    value, x = zoo.rough_network(2, seed=4), zoo.states(problem, 300)
    value.head.bias.requires_grad_(True)
    (moved,) = torch.autograd.grad(loss(problem, value, x, M), [value.head.bias])
    assert float(moved.abs().max()) < 1e-12
