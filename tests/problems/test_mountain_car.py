"""The mountain car: its energy, its goal, which ends the cost and is no failure, and its limits."""

import math

import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.problems import MountainCar
from ocp_torch.runs.metrics.classical import classical_policy
from ocp_torch.runs.metrics.measures import measure, simulate

CAR = MountainCar()


def on_torus(*states):
    return CAR.to_torus(torch.tensor(states, dtype=torch.float64))


def test_the_force_alone_changes_the_energy_by_the_work_it_does():
    s = torch.rand(50, 2, dtype=torch.float64) * torch.tensor([1.6, 0.14]) - torch.tensor([1.2, 0.07])
    a, B = CAR.dynamics(s)
    (slope,) = torch.autograd.grad(CAR.energy(s.requires_grad_()).sum(), s)
    torch.testing.assert_close((slope * a).sum(-1), torch.zeros(50).double(), rtol=0.0, atol=1e-15)
    torch.testing.assert_close((slope * B[..., 0]).sum(-1), CAR.power * s[:, 1])


def test_the_goal_ends_motion_and_cost_and_is_no_failure_but_the_sides_are():
    seam = 0.125 * (CAR.high - CAR.low)
    x = on_torus([0.449, 0.01], [0.6, 0.01], [CAR.low - seam, 0.0], [0.0, 0.0874], [0.55, 0.01])
    cost, speed = CAR.state_cost(x), CAR.drift(x).abs().sum(-1) + CAR.control_matrix(x).abs().sum((1, 2))
    assert cost[[0, 2, 3]].tolist() == pytest.approx([0.05] * 3)
    assert max(float(cost[1]), float(speed[1])) < 1e-30
    assert 0.0 < float(cost[4]) < 0.05
    assert 0.0 < float(speed[4]) < float(speed[0])
    assert CAR.arrived(x).tolist() == [False, True, False, False, True]
    assert CAR.outside(x).tolist() == [False, False, True, True, False]


@pytest.mark.nightly
def test_the_classical_car_arrives_from_the_valley_and_one_without_force_stays():
    start = on_torus(*[[p, 0.001] for p in (-0.6, -0.5, -0.4)])
    path = simulate(CAR, classical_policy(CAR), start, 400.0, 800)
    assert measure(CAR, path)["arrived"] == 1.0
    still = simulate(CAR, lambda x: torch.zeros_like(x[:, :1]), start, 400.0, 800)
    assert measure(CAR, still) == {"arrived": 0.0, "left": 0.0}
    # Who waits pays for ever; who arrives pays for the way alone, and not the 0.15 of full force for ever.
    torch.testing.assert_close(
        still.cost, torch.full((3,), 0.05 * (1.0 - math.exp(-2.0))).double(), rtol=1e-4, atol=0.0
    )
    assert bool((path.cost < 0.08).all())


def test_noise_lets_nobody_say_that_mu_is_unbounded():
    assert CAR.occupation_bound == math.inf
    assert MountainCar(force_noise=0.1).occupation_bound is None


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (dict(low=0.5), "problem.goal is 0.45, but must be above 0.5"),
        (dict(high=0.4), "problem.high is 0.4, but must be above 0.45"),
        (dict(time_cost=0.0), "problem.time_cost is 0, but must be above 0"),
        (dict(power=-1.0), "problem.power is -1, but must be above 0"),
    ],
)
def test_wrong_arguments_get_one_sentence(wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        MountainCar(**wrong)
