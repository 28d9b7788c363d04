"""Steps of an environment where there is noise: mean and covariance, and that they repeat. Skipped where Gymnasium is not."""

import math

import numpy as np
import pytest
import torch

from ocp_torch.gym.environment import ControlEnvironment
from ocp_torch.problems import Problem, Unicycle

TURN = 2.0 * math.pi


class Adrift(Problem):
    """A constant drift, and noise of two motions that share a coordinate."""

    SIGMA = torch.tensor([[0.05, 0.0], [0.03, 0.04]], dtype=torch.float64)

    def __init__(self):
        super().__init__(dim=2)

    def state_cost(self, x):
        return 1.0 + torch.cos(TURN * x[:, 0])

    def drift(self, x):
        return x.new_tensor([0.1, -0.2]).expand(len(x), 2)

    def noise(self, x):
        return self.SIGMA.to(x).expand(len(x), 2, 2)


def steps_of(problem, count, seed=3, **options):
    """What ``count`` steps without control move the state by, ``(count, d)``."""
    pytest.importorskip("gymnasium")
    env = ControlEnvironment(problem, control_bound=1.0, **options)
    before, moved = env.reset(seed=seed)[1]["state"], []
    for _ in range(count):
        after = env.step(np.zeros(problem.control_dim))[4]["state"]
        moved.append((after - before + 0.5) % 1.0 - 0.5)
        before = after
    return np.array(moved)


def test_steps_of_an_environment_have_the_mean_and_the_covariance_of_the_noise():
    """`a dt` and `sigma sigma^T dt`, and no step depends on the one before."""
    dt, count = 0.2, 3000
    moved = steps_of(Adrift(), count, time_step=dt)
    spread = (Adrift.SIGMA @ Adrift.SIGMA.T).numpy() * dt
    size = np.sqrt(np.diag(spread))
    assert np.abs((moved.mean(axis=0) - dt * np.array([0.1, -0.2])) / size).max() < 5.0 / math.sqrt(count)
    off = (np.cov(moved.T) - spread) / np.outer(size, size)
    assert np.abs(off).max() < 5.0 * math.sqrt(2.0 / count)
    centred = moved - moved.mean(axis=0)
    assert np.abs((centred[1:] * centred[:-1]).mean(axis=0) / size**2).max() < 5.0 / math.sqrt(count)


def test_noise_of_an_environment_repeats_by_its_seed():
    first, again, other = (steps_of(Adrift(), 4, seed) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_heading_in_an_environment_strays_by_its_noise():
    """In rad^2 for each second."""
    moved = TURN * steps_of(Unicycle(heading_noise=0.2), 1500, time_step=0.5)[:, 2]
    assert moved.var() == pytest.approx(0.2**2 * 0.5, rel=5.0 * math.sqrt(2.0 / 1500))
