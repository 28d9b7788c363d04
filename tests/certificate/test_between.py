"""Walls so thin that every step jumps over them: a path would stay there, and the interval of what it costs says so."""

import math
from dataclasses import replace

import pytest
import torch

from ocp_torch import certify
from ocp_torch.certificate.simulated.between import stopped
from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.control.policies import ValuePolicy, zero_policy
from ocp_torch.problems import Circle
from ocp_torch.problems.problem import Problem
from support import zoo
from support.honesty import BARE

TURN, AT = 2.0 * math.pi, 0.37123


def away(x):
    return (x - AT + 0.5).remainder(1.0) - 0.5


class River(Problem):
    """Flows to the right at speed 1, and costs most at `AT`, where a wall of some ``width`` may stand."""

    def __init__(self, width: float = 0.0, smooth: bool = False) -> None:
        self.width, self.steep = width, smooth
        super().__init__(1, discount=1.0, control_limit=1e-6 if width else None)

    def state_cost(self, x):
        return 1.0 + (TURN * (x[:, 0] - AT)).cos()

    def drift(self, x):
        if not self.width:
            return torch.ones_like(x)
        bump = (-(away(x) / self.width).square()).exp() if self.steep else (away(x).abs() < 0.5 * self.width).to(x)
        return 1.0 - 2.0 * bump


def cost_of_staying(paid: float = 0.0) -> float:
    """From a uniform start, to the wall at speed 1 and then for ever there, at a cost of 2 and what is ``paid`` on top."""
    T = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)
    t = T.unsqueeze(-1) * T  # times up to each T
    on_the_way = T * ((-t).exp() * (1.0 + (TURN * (T.unsqueeze(-1) - t)).cos())).mean(dim=1)
    return float((on_the_way + (-T).exp() * (2.0 + paid)).mean())


def simulated(problem, policy, trajectories=64, **how):
    return Simulation(problem, policy, trajectories, 4, seed=0, tolerance=5e-3, **how).run()


@pytest.mark.parametrize(
    ("width", "smooth"),
    [(1e-3, False), pytest.param(1e-3, True, marks=pytest.mark.nightly), (1e-4, False), (1e-4, True)],
)
def test_walls_of_the_drift_are_noticed(width, smooth):
    problem, truth = River(width, smooth), cost_of_staying()
    found = simulated(problem, zero_policy(problem))
    low, high = found.perf.interval(0.95)
    assert "the velocity is 0 or has the other sign" in found.jumped_over
    assert low <= truth <= high
    assert found.perf.value < truth - 0.3  # as if there were no wall


@pytest.mark.nightly
def test_a_wall_of_a_controller_is_noticed_and_told():
    barrier = lambda x: torch.where(away(x).abs() < 5e-4, -2.0, 0.0).to(x)
    settings = replace(BARE, trajectories=32, replicates=2, points=64)
    certificate = certify(River(), barrier, settings=settings, train_steps=0)
    low, high = certificate.perf["given"].interval(0.95)
    assert low <= cost_of_staying(paid=1.0) <= high
    said = "nothing certain is known of what this controller costs: at x = [0.37"
    assert any(w.startswith(said) for w in certificate.warnings)


@pytest.mark.nightly
def test_a_wall_that_finer_steps_meet_is_resolved():
    problem = River(1e-2, smooth=True)
    found = simulated(problem, zero_policy(problem))
    assert found.jumped_over == ""
    low, high = found.perf.interval(0.999)
    assert low <= cost_of_staying() + 0.01
    assert high >= cost_of_staying() - 0.01
    assert high - low < 0.1


class Lottery(Problem):
    """From everywhere to `y = 0`, where one in some 5,000 `x`, which never changes, costs 10,000."""

    def state_cost(self, z):
        near = (-(away(z[:, 0] + 0.1) / 1e-4).square() - (1.0 - (TURN * z[:, 1]).cos()) / 0.1).exp()
        return 1.0 + 1e4 * near

    def drift(self, z):
        return torch.stack([torch.zeros_like(z[:, 0]), -(TURN * z[:, 1]).sin()], dim=-1)

    def initial_density(self, z):
        return 1.0 + (TURN * z[:, 1]).cos().neg()


def test_dear_states_that_no_path_came_to_are_told():
    problem = Lottery(2, discount=1.0)
    found = simulated(problem, zero_policy(problem))
    assert found.perf.value == pytest.approx(1.0, abs=0.02)
    assert found.unmet > 1.0
    assert simulated(River(), zero_policy(River())).unmet == 0.0


class Notched(Circle):
    """Noise that vanishes at a point, which no path can pass."""

    def noise(self, x):
        return (0.3 * (1.0 - (-(away(x) / 1e-3).square()).exp())).unsqueeze(-1)


def test_where_noise_vanishes_paths_may_end():
    problem = Notched()
    found = simulated(problem, zero_policy(problem))
    assert "there is no noise" in found.jumped_over
    assert found.perf.half_width(0.95) >= float(problem.state_cost(torch.tensor([[0.99]], dtype=torch.float64)))


class NoisyRiver(River):
    """Beside the river there is a coordinate that noise moves, and nothing else."""

    def __init__(self) -> None:
        super().__init__(1e-3)
        self.dim = 2

    def drift(self, x):
        return torch.cat([super().drift(x[:, :1]), torch.zeros_like(x[:, :1])], dim=-1)

    def control_matrix(self, x):
        return x.new_zeros(len(x), 2, 1)

    def noise(self, x):
        return x.new_tensor([[0.0], [0.1]]).expand(len(x), 2, 1)


def test_a_wall_is_one_where_another_coordinate_has_noise():
    problem = NoisyRiver()
    found = simulated(problem, zero_policy(problem), trajectories=16)
    assert "the velocity is 0 or has the other sign" in found.jumped_over
    assert found.perf.interval(0.95)[1] >= cost_of_staying()


@zoo.on((*zoo.FEW, *zoo.NATURAL))
def test_nothing_is_seen_where_nothing_is(problem):
    """Optimal controllers, no control, and the controller of a `V` that knows nothing of the problem."""
    rough = ValuePolicy(problem, zoo.rough_network(problem.dim, seed=1, size=0.1))
    exact = problem.exact_control(torch.rand(2, problem.dim, dtype=torch.float64)) is not None
    for policy in (problem.exact_control if exact else zero_policy(problem), rough):
        assert simulated(problem, policy, trajectories=4, doublings=1).jumped_over == ""


def test_what_counts_is_a_coordinate_that_moves_steadily():
    """A path that turns, one that slides along a jump and one at rest are let pass."""
    t = torch.linspace(0.0, 1.0, 41, dtype=torch.float64)
    path = torch.stack([t, 0.5 + 0.2 * (TURN * t).sin()], dim=-1).unsqueeze(1)
    circling = lambda x: torch.stack([torch.ones_like(x[:, 0]), 0.2 * TURN * (TURN * x[:, 0]).cos()], dim=-1)
    assert stopped(circling, path) is None
    walled = lambda x: torch.where((x[:, :1] - 0.5061).abs() < 2e-3, -1.0, 1.0) * circling(x)
    assert stopped(walled, path) is not None
    sliding = torch.stack([t, 0.5 + 1e-3 * (-1.0) ** torch.arange(41)], dim=-1).unsqueeze(1)
    assert stopped(lambda x: torch.stack([torch.ones_like(x[:, 0]), (0.5 - x[:, 1]).sign()], dim=-1), sliding) is None
    still = torch.full((41, 1, 2), 0.3, dtype=torch.float64) + 1e-7 * t[:, None, None]
    assert stopped(lambda x: 1e-7 * torch.where(x < 0.3 + 4.9e-8, 1.0, -1.0), still) is None
