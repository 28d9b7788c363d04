"""Controllers with jumps, bang-bang and sliding, and costs two grids miss together: errors stay within what is stated."""

import math

import pytest
import torch

from ocp_torch.certificate.checks.observed import largest_jump
from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.problems import Circle, Problem
from ocp_torch.runs.build import build_certificate_settings
from support import zoo
from support.small import small
from support.switching import cost_of_switching

pytestmark = pytest.mark.usefixtures("quick_composition")


def switched(left: float, right: float):
    """Velocity ``left`` below 1/2 and ``-right`` above: slides at 1/2."""
    return lambda x: torch.where(x.remainder(1.0) < 0.5, left, -right)


def assert_within(perf, truth: float):
    assert abs(perf.value - truth) <= perf.bias + 3.0 * perf.se


@pytest.mark.parametrize("horizon", ["truncated", "random"])
@pytest.mark.parametrize(("left", "right"), [(1.0, 1.0), (0.2, 0.9)])
def test_a_sliding_mode_costs_what_the_mixture_of_its_two_sides_costs(left, right, horizon):
    perf = Simulation(Circle(), switched(left, right), 16, 8, seed=1, horizon=horizon).run().perf
    assert_within(perf, cost_of_switching(left, right))
    if horizon == "truncated":
        assert perf.bias < 0.05 * perf.value


class Bump(Problem):
    """A narrow cost that every trajectory of the constant flow passes, between most steps of a coarse grid."""

    def __init__(self, width: float) -> None:
        super().__init__(dim=1)
        self.width = width

    def state_cost(self, x):
        return ((x[:, 0].remainder(1.0) - 0.5).abs() < 0.5 * self.width).to(x) / self.width

    def drift(self, x):
        return torch.ones_like(x)


@pytest.mark.parametrize("width", [0.05, 0.01])
def test_what_both_grids_miss_is_in_the_bias(width):
    problem = Bump(width)
    perf = Simulation(problem, lambda x: torch.zeros_like(x), 64, 8, seed=0).run().perf
    assert_within(perf, 1.0)


@zoo.on(("circle rho=2", "torus 2-d chain"))
def test_the_optimal_jumps_cost_no_accuracy(problem):
    perf = Simulation(problem, problem.exact_control, 256, 8, seed=3).run().perf
    assert_within(perf, problem.exact_optimum)
    assert perf.bias <= 1e-4 * problem.exact_optimum


@pytest.mark.nightly
@zoo.on(("circle rho=2", "torus 2-d chain", "manufactured 2-d mu0"))
def test_the_random_horizon_agrees_with_the_truncated_one(problem):
    kinds = ("truncated", "random")
    truncated, random = (
        Simulation(problem, problem.exact_control, 64, 8, seed=5, horizon=kind).run().perf for kind in kinds
    )
    allowed = 4.5 * math.hypot(truncated.se, random.se) + truncated.bias + random.bias
    assert abs(truncated.value - random.value) <= allowed
    assert allowed < 0.15 * truncated.value


JUMPING = {
    "switch": (lambda x: torch.where(x.remainder(1.0) < 0.3, 1.0, -1.0), 2.0),
    "seam": (lambda x: x.remainder(1.0) - 0.5, 1.0),
    "small": (lambda x: (x.remainder(1.0) < 0.5).to(x) * 0.01 + (2 * math.pi * x).sin(), 0.01),
}
REGULAR = {
    "steep": lambda x: (1000.0 * (2 * math.pi * x).sin()).tanh(),
    "clamped": lambda x: (50.0 * (2 * math.pi * x).sin()).clamp(-0.1, 0.1),
    "zero": lambda x: torch.zeros_like(x),
    "float32": lambda x: (2 * math.pi * x.float()).sin().to(x),
}


@pytest.mark.parametrize("dim", [1, 3])
@pytest.mark.parametrize("name", JUMPING)
def test_jumps_are_found_with_their_size(name, dim):
    policy, size = JUMPING[name]
    found = largest_jump(lambda x: policy(x[:, :1]), dim)
    assert found.size == pytest.approx(size, rel=1e-3)


@pytest.mark.parametrize("name", REGULAR)
def test_what_is_steep_or_bent_is_no_jump(name):
    assert largest_jump(REGULAR[name], 2).size == 0.0


@pytest.mark.nightly
def test_jumps_are_looked_for_where_a_bound_needs_that_there_are_none():
    trainer = small("method=dual")
    jump = lambda steps: (
        trainer.certify(
            build_certificate_settings(small(f"certificate.stage.steps={steps}").config)
        ).assumptions.largest_jump
    )
    assert trainer.evaluator.evaluate(trainer.run).assumptions.largest_jump is None
    assert jump(0) is None
    assert jump(5) == 0.0
    both = small("method=pd")
    assert both.evaluator.evaluate(both.run).assumptions.largest_jump == 0.0
