"""Environments and maps to them that somebody else wrote: each of their faults is one sentence, and none is a return."""

import logging

import numpy as np
import pytest

import ocp_torch.gym.rollout
from ocp_torch import InputError
from ocp_torch.gym.rollout import play, step_of
from ocp_torch.problems import Pendulum

gymnasium = pytest.importorskip("gymnasium")
NAME = "Pendulum-v1"


class Theirs(gymnasium.Env):
    """Shows an upright pendulum for four steps, but for what ``faults`` put in the place of ``reset`` or ``step``."""

    action_space = gymnasium.spaces.Box(-2.0, 2.0, (1,), np.float32)

    def __init__(self, **faults) -> None:
        self.count = 0
        vars(self).update(faults)

    def reset(self, seed=None):
        self.count = 0
        return np.array([1.0, 0.0, 0.0]), {}

    def step(self, action):
        self.count += 1
        return np.array([1.0, 0.0, 0.0]), -1.0, False, self.count == 4, {}


class Player:
    """Does nothing with a pendulum whose maps are those of ``faults`` where they name some."""

    kind = "a test's"

    def __init__(self, **faults) -> None:
        self.problem = type("Mine", (Pendulum,), faults)()

    def __call__(self, x):
        return np.zeros((len(x), 1))


def broken(*_, **__):
    raise RuntimeError("no display\nat all")


SHOWN = np.array([1.0, 0.0, 0.0])
ENVIRONMENTS = {
    "reset raises": (dict(reset=broken), "raised RuntimeError: no display at all"),
    "step raises": (dict(step=broken), "raised RuntimeError: no display at all"),
    "of an older kind": (dict(step=lambda action: (SHOWN, 0.0, False, {})), "raised ValueError: not enough values"),
    "reward": (dict(step=lambda action: (SHOWN, np.nan, False, True, {})), "Pendulum-v1 gave the reward nan"),
}
MAPS = {
    "observed raises": (dict(observed=broken), r"raised RuntimeError: no display at all \(.*, line"),
    "one number": (
        dict(observed=lambda self, seen: seen[:1]),
        r"observed of Mine gave shape \(1,\), but must give \(2,\)",
    ),
    "nothing": (dict(observed=lambda self, seen: None), r"observed of Mine gave shape \(\), but must give \(2,\)"),
    "action raises": (dict(action=broken), r"raised RuntimeError: no display at all \(.*, line"),
    "no number": (dict(action=lambda self, u: u * np.nan), r"to_action gave \[nan\] for Pendulum-v1"),
}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_what_an_environment_does_wrong_is_one_sentence(name):
    faults, words = ENVIRONMENTS[name]
    with pytest.raises(InputError, match=words):
        play(Player(), Theirs(**faults), NAME, 1, 0)


@pytest.mark.parametrize("name", MAPS)
def test_what_a_map_does_wrong_is_one_sentence(name):
    """One number had been taken for all coordinates, and a return was told of another state."""
    faults, words = MAPS[name]
    with pytest.raises(InputError, match=words):
        play(Player(**faults), Theirs(), NAME, 1, 0)


def test_an_episode_without_end_is_told(monkeypatch, caplog):
    monkeypatch.setattr(ocp_torch.gym.rollout, "MOST_STEPS", 3)
    with caplog.at_level(logging.WARNING):
        assert play(Player(), Theirs(), NAME, 2, 0).lengths.tolist() == [3, 3]
        assert caplog.text.count("2 of 2 episodes had no end within 3 steps") == 1
        monkeypatch.setattr(ocp_torch.gym.rollout, "MOST_STEPS", 9)
        assert play(Player(), Theirs(), NAME, 1, 0).lengths.tolist() == [4]
        assert caplog.text.count("no end") == 1


def test_actions_beyond_the_limits_of_an_environment_are_told_and_those_at_them_are_not(caplog):
    most = float(np.float32(2.0)) * (1.0 + 1e-8)
    for torque, cut in ((most, 0), (2.5, 4)):
        with caplog.at_level(logging.WARNING):
            play(Player(action=lambda self, u, given=torque: np.full(1, given)), Theirs(), NAME, 1, 0)
        assert ("4 of 4 actions were beyond its limits" in caplog.text) == bool(cut)


def test_actions_that_count_are_cut_before_they_become_whole_numbers():
    """-1 had become 255, and .9 nothing."""
    seen = []
    theirs = lambda: Theirs(step=lambda action: (SHOWN, seen.append(action) or 0.0, False, True, {}))
    bytes_, count = gymnasium.spaces.Box(0, 255, (1,), np.uint8), gymnasium.spaces.Discrete(3)
    for space, given, gives in ((bytes_, [-1.0], 0), (bytes_, [256.0], 255), (count, 2.0, 2)):
        env, player = theirs(), Player(action=lambda self, u, given=given: np.array(given))
        env.action_space = space
        play(player, env, NAME, 1, 0)
        assert seen.pop() == gives
    env, player = theirs(), Player(action=lambda self, u: np.array(0.9))
    env.action_space = count
    with pytest.raises(InputError, match="to_action gave 0.9 for Pendulum-v1, but must give whole numbers"):
        play(player, env, NAME, 1, 0)


SPACES = gymnasium.spaces


@pytest.mark.parametrize(
    ("space", "given"),
    [
        (SPACES.Discrete(3), -1),
        (SPACES.Discrete(3), 3),
        (SPACES.MultiDiscrete([3, 3]), [1, 5]),
        (SPACES.MultiBinary(1), [7]),
    ],
)
def test_a_number_that_counts_no_action_is_refused(space, given):
    """A list of actions that is asked for its number -1 gives its last one."""
    env = Theirs(action_space=space)
    with pytest.raises(InputError, match=r"to_action gave .* for Pendulum-v1, but must give one of "):
        play(Player(action=lambda self, u: np.array(given)), env, NAME, 1, 0)


@pytest.mark.parametrize("space", [SPACES.Dict(push=SPACES.Discrete(3)), SPACES.Tuple([SPACES.Discrete(3)])])
def test_actions_that_are_no_array_are_refused(space):
    with pytest.raises(InputError, match="the actions of Pendulum-v1 are a (Dict|Tuple), but a controller gives one"):
        play(Player(), Theirs(action_space=space), NAME, 1, 0)


def test_an_observation_that_is_a_dict_reaches_the_map():
    seen = {"observation": SHOWN, "goal": np.zeros(2)}
    env = Theirs(reset=lambda seed=None: (seen, {}), step=lambda action: (seen, -1.0, False, True, {}))
    shown = lambda self, observation: observation["observation"][1:]
    assert play(Player(observed=shown), env, NAME, 1, 0).lengths.tolist() == [1]


def test_an_environment_with_a_map_of_its_own_by_that_name_is_not_taken_for_ours():
    assert play(Player(), Theirs(from_observation=lambda seen: seen), NAME, 1, 0).lengths.tolist() == [4]


@pytest.mark.parametrize("number", [float, np.float32, np.float64])
def test_the_time_of_a_step_may_be_any_kind_of_number(number):
    assert step_of(Theirs(dt=number(0.25))) == 0.25
    assert step_of(Theirs(dt=number(-0.25))) is None
