"""An environment that moves otherwise than the model of the controller is told with a coordinate and numbers; no other."""

import logging
import re
from contextlib import closing

import numpy as np
import pytest
import torch

from ocp_torch.gym.rollout import made, play
from ocp_torch.problems import Pendulum
from ocp_torch.runs.metrics.classical import classical_policy

gymnasium = pytest.importorskip("gymnasium")
NAME = "Pendulum-v1"
MODEL = Pendulum()


class Player:
    """The classical controller of the pendulum, whose maps are those of ``maps`` where they name some."""

    kind = "a test's"

    def __init__(self, **maps) -> None:
        self.problem, self.policy = type("Mine", (Pendulum,), maps)(), classical_policy(MODEL)

    def __call__(self, x):
        return self.policy(torch.from_numpy(x)).numpy()


class Swinging(gymnasium.Env):
    """The model itself in steps of ``dt``, each of so many of Euler's."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, dt: float, parts: int, kicks: float = 0.0) -> None:
        self.dt, self.held, self.parts, self.kicks = dt, dt, parts, kicks

    def reset(self, seed=None):
        self.s, self.count, self.chance = torch.tensor([[2.0, 0.5]], dtype=torch.float64), 0, np.random.default_rng(0)
        return self.shown(), {}

    def shown(self):
        angle, speed = self.s[0].tolist()
        return np.array([np.cos(angle), np.sin(angle), speed], dtype=np.float32)

    def step(self, action):
        for _ in range(self.parts):
            a, B = MODEL.dynamics(self.s)
            self.s = self.s + self.held / self.parts * (a + B[..., 0] * float(action[0]))
        self.s[0, 1] += self.kicks * self.held**0.5 * self.chance.standard_normal()
        self.count += 1
        return self.shown(), -1.0, False, self.count == 100, {}


def warned(caplog, env, **maps) -> str:
    with closing(env), caplog.at_level(logging.WARNING):
        play(Player(**maps), env, NAME, 2, 0)
    said = [record.getMessage() for record in caplog.records if "does not move as the model" in record.getMessage()]
    assert len(said) <= 1
    return "".join(said)


def theirs(**parameters):
    env = made(NAME)
    vars(env.unwrapped).update(parameters)
    return env


def test_the_environment_that_the_model_is_of_agrees(caplog):
    assert warned(caplog, theirs()) == ""


@pytest.mark.parametrize(("dt", "parts"), [(0.05, 1), (0.05, 100), (0.2, 100)])
def test_coarse_and_fine_steps_of_the_same_motion_agree(caplog, dt, parts):
    assert warned(caplog, Swinging(dt, parts)) == ""


@pytest.mark.parametrize("parameters", [{"m": 1.1}, {"m": 0.9}, {"l": 1.1}, {"g": 11.0}])
def test_a_wrong_parameter_is_told_with_two_numbers(caplog, parameters):
    number = r"-?[0-9.e-]+"
    words = rf"in a step of 0.05 velocity changed by {number} rad/s, where the model says {number} to {number} \(.* %"
    assert re.search(words, warned(caplog, theirs(**parameters)))


def test_another_order_of_observations_is_told(caplog):
    swapped = lambda self, seen: np.array([np.arctan2(seen[0], seen[1]), seen[2]])
    assert "angle changed by" in warned(caplog, theirs(), observed=swapped)


def test_a_step_that_is_not_as_long_as_the_environment_says_is_told(caplog):
    env = Swinging(0.05, 10)
    env.time_step = 0.045  # which is asked for before dt
    assert "in a step of 0.045" in warned(caplog, env)


class Falling(Swinging):
    """Over after ``most`` steps, as where a wrong model lets a pole fall at once."""

    def __init__(self, most: int) -> None:
        super().__init__(0.05, 100)
        self.most = most

    def step(self, action):
        seen, reward, *_ = super().step(action)
        return seen, reward, self.count == self.most, False, {}


@pytest.mark.parametrize(("most", "episodes", "told"), [(2, 9, False), (2, 10, True), (5, 3, True), (1, 20, False)])
def test_episodes_that_are_too_short_are_put_together(caplog, most, episodes, told):
    """Each has a step less than actions; from its end to the next start nothing moves."""
    for maps in ({"action": lambda self, u: np.clip(0.5 * u, -1.9, 1.9)}, {}):
        caplog.clear()
        player = Player(**maps)
        player.policy = lambda x: 0.5 * torch.ones(len(x), 1)
        with caplog.at_level(logging.WARNING):
            play(player, Falling(most), NAME, episodes, 0)
        assert ("does not move" in caplog.text) == (told and bool(maps))


def test_an_environment_that_does_not_say_how_long_a_step_is_is_not_compared(caplog):
    env = Swinging(0.05, 10)
    env.dt = None
    assert warned(caplog, env, action=lambda self, u: 0.5 * u) == ""


def test_an_action_of_another_unit_is_told(caplog):
    assert "velocity changed by" in warned(caplog, theirs(), action=lambda self, u: np.clip(0.5 * u, -2.0, 2.0))


def test_a_torque_at_the_limit_of_the_environment_may_be_another_than_the_models(caplog):
    player = Player()
    player.policy = lambda x: 3.0 * classical_policy(MODEL)(x)
    with caplog.at_level(logging.WARNING):
        play(player, theirs(), NAME, 1, 0)
    assert "does not move" not in caplog.text


def test_noise_of_the_model_is_allowed_for(caplog):
    shaken = Swinging(0.05, 20, kicks=0.5)
    assert "velocity" in warned(caplog, shaken)
    caplog.clear()
    player = Player()
    player.problem = Pendulum(torque_noise=0.5 / 3.0)
    with caplog.at_level(logging.WARNING):
        play(player, Swinging(0.05, 20, kicks=0.5), NAME, 1, 0)
    assert "does not move" not in caplog.text
