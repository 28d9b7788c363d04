"""A saved controller as an agent in any Gymnasium environment: episodes are played, printed and filmed."""

import logging
import math
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ocp_torch.control.controller import Controller
from ocp_torch.control.policies import TRAJECTORIES
from ocp_torch.errors import InputError, first_line, require_integer
from ocp_torch.files.storage import write_atomically
from ocp_torch.gym.agreement import Agreement
from ocp_torch.gym.environment import ControlEnvironment, require_gymnasium
from ocp_torch.problems.blame import in_their_words
from ocp_torch.problems.problem import Problem
from ocp_torch.runs.evaluate import load_run

log = logging.getLogger(__name__)

# Frames of a video, at most.
MOST_FRAMES = 600
# Steps of an episode, at most: an environment may have no end.
MOST_STEPS = 100_000
# Rounding of an action at the limit of an environment, in single precision.
ROUNDING = 1e-6
# The environment of a user's own problem.
OWN = "ocp_torch/Problem-v0"
# Attributes with the time of a step: in our environments; in Pendulum-v1, MuJoCo's and Acrobot-v1; in CartPole-v1.
STEP_NAMES = ("time_step", "dt", "tau")


class Agent:
    """``controller`` in the environment ``env`` (its id is ``name``): observations to states, controls to actions.

    An environment of ours translates itself; for any other the controller's problem does, by `Problem.from_observation` and
    `Problem.to_action`. Raises `InputError` where neither can, or the result does not fit.
    """

    def __init__(self, controller: Controller, env, name: str) -> None:
        self.controller, self.name, self.space = controller, name, env.action_space
        self.acted = self.cut = 0  # actions, and how many of them the environment does not allow
        own = env.unwrapped
        self.step, ours = step_of(own), isinstance(own, ControlEnvironment)
        if self.space.shape is None:
            kind = type(self.space).__name__
            raise InputError(f"the actions of {name} are a {kind}, but a controller gives one array of numbers.")
        if ours:
            if own.problem.dim != controller.problem.dim or own.problem.control_dim != controller.problem.control_dim:
                raise InputError(
                    f"{name} has d = {own.problem.dim}, m = {own.problem.control_dim}, but the controller is for "
                    f"d = {controller.problem.dim}, m = {controller.problem.control_dim}."
                )
            self._state, self._action = own.from_observation, own.to_action
        else:
            self._state = partial(controller.problem.from_observation, name)
            self._action = partial(controller.problem.to_action, name)
        self.agreement = Agreement(controller.problem, self.step, self.space) if self.step and not ours else None

    def act(self, observation) -> np.ndarray:
        """The action for ``observation``."""
        d = self.controller.problem.dim
        asked = lambda what, function: in_their_words(
            function, f"{what} for {self.name}", type(self.controller.problem)
        )
        state = asked("from_observation", lambda: np.asarray(self._state(observation), dtype=np.float64))
        if state.shape != (d,) or not np.isfinite(state).all():
            raise InputError(f"from_observation gave {state} for {self.name}, but must give {d} finite coordinates.")
        step = self.step if self.controller.kind == TRAJECTORIES else None
        control = (self.controller(state[None]) if step is None else self.controller.held(state[None], step))[0]
        given = asked("to_action", lambda: np.asarray(self._action(control), dtype=np.float64))
        if given.shape != self.space.shape:
            raise InputError(
                f"to_action gave shape {given.shape} for {self.name}, whose actions have shape {self.space.shape}."
            )
        if not np.isfinite(given).all():
            raise InputError(f"to_action gave {given} for {self.name}, but must give finite numbers.")
        within = np.clip(given, self.space.low, self.space.high) if hasattr(self.space, "low") else given
        self.acted, self.cut = self.acted + 1, self.cut + int((abs(given - within) > ROUNDING * abs(given)).any())
        action = within.astype(self.space.dtype)
        if np.issubdtype(action.dtype, np.integer) and (action != within).any():
            raise InputError(f"to_action gave {given} for {self.name}, but must give whole numbers.")
        if not hasattr(self.space, "low") and not self.space.contains(action):
            raise InputError(f"to_action gave {given} for {self.name}, but must give one of {self.space}.")
        if self.agreement is not None:
            self.agreement.acted(state, control, action)
        return action

    def ended(self) -> None:
        """Say, after the first episodes with enough steps, where the environment moved otherwise than the model."""
        if self.agreement is None or (difference := self.agreement.difference()) is None:
            return
        if difference:
            look = "compare parameters, the order of observations, actions and the unit of time"
            log.warning("warning: %s does not move as the model: %s; %s.", self.name, difference, look)
        self.agreement = None


def step_of(env) -> float | None:
    """The time for which ``env`` holds an action, in its unit, from one of the attributes `STEP_NAMES`; `None` without."""
    told = (getattr(env, name, None) for name in STEP_NAMES)
    return next((s for t in told if isinstance(t, Real) and 0.0 < (s := float(t)) < math.inf), None)


@dataclass(frozen=True)
class Rollouts:
    """Undiscounted ``returns`` and ``lengths`` per episode."""

    returns: np.ndarray
    lengths: np.ndarray

    def __str__(self) -> str:
        low, high, count = self.returns.min(), self.returns.max(), len(self.returns)
        se = self.returns.std(ddof=1) / math.sqrt(count) if count > 1 else 0.0
        return (
            f"return {self.returns.mean():.6g} ± {se:.2g} (standard error of {count} episodes), from {low:.6g} to "
            f"{high:.6g}; {self.lengths.mean():.1f} steps each"
        )


class RolloutJob:
    """A job of the command: a saved controller and an environment it can act in. Raises `InputError` for a wrong field."""

    def __init__(self, config: dict) -> None:
        self.controller = load_run(config)
        self.video = None if config["video"] is None else Path(str(config["video"]))
        if self.video is not None and self.video.suffix != ".gif":
            raise InputError(f"video is {str(self.video)!r}, but must be a file whose name ends in .gif.")
        self.env = str(config["env"])
        with closing(self.environment()) as env:
            Agent(self.controller, env, self.env).act(started(env, self.env, 0))
        self.episodes = require_integer("episodes", config["episodes"], 1, maximum=10**6)
        self.seed = require_integer("seed", config["seed"], 0)

    def run(self) -> Rollouts:
        """Play the episodes and print their returns; film the first one again, if asked to."""
        mine = self.controller.problem
        with closing(self.environment()) as env:
            theirs = getattr(env.unwrapped, "problem", mine)
            if isinstance(theirs, Problem) and type(theirs) is not type(mine):  # a stranger's may be anything
                said = "warning: %s is of the problem %s, but the controller is for %s."
                log.warning(said, self.env, type(theirs).__name__, type(mine).__name__)
            found = play(self.controller, env, self.env, self.episodes, self.seed)
        log.info("%s: %s", self.env, found)
        if self.video is not None:
            frames: list[np.ndarray] = []
            with closing(self.environment(render_mode="rgb_array")) as env:
                play(self.controller, env, self.env, 1, self.seed, frames)
                save_gif(self.video, frames, env.metadata.get("render_fps", 15))
            log.info("%d frames in %s", len(frames), self.video)
        return found

    def environment(self, **options):
        """The environment; `Problem-v0`, and that of the class of the controller's problem, are made of this very problem."""
        problem = self.controller.problem
        own = (f"ocp_torch/{type(problem).__name__}-v0", OWN)
        return made(self.env, **({"problem": problem} if self.env in own else {}), **options)


def made(name: str, **options):
    """The environment ``name``. Raises `InputError` where Gymnasium has none, or cannot make it here."""
    gymnasium = require_gymnasium()
    try:
        return gymnasium.make(name, **options)
    except InputError:
        raise
    except Exception as error:  # whatever a stranger's environment may raise
        unknown = isinstance(error, gymnasium.error.NameNotFound | gymnasium.error.NamespaceNotFound)
        yours = "; one of your own is named module:Id-v0, after the module that registers it" if unknown else ""
        raise InputError(f"env is {name!r}, which cannot be made: {first_line(error).rstrip('.')}{yours}.") from None


def play(controller: Controller, env, name: str, episodes: int, seed: int, frames: list | None = None) -> Rollouts:
    """Play ``episodes`` seeded ``seed``, ``seed + 1``, ...; pictures of all states are put into ``frames``."""
    agent = Agent(controller, env, name)
    returns, lengths, endless = [], [], 0
    for k in range(episodes):
        observation = started(env, name, seed + k)
        total, count, over = 0.0, 0, False
        while not over and count < MOST_STEPS:
            if frames is not None and len(frames) < MOST_FRAMES:
                frames.append(_picture(env, name))
            observation, reward, over = stepped(env, name, agent.act(observation))
            total, count = total + reward, count + 1
        endless += not over
        returns.append(total)
        lengths.append(count)
        agent.ended()
    if endless:
        log.warning(
            "warning: %s: %d of %d episodes had no end within %s steps.", name, endless, episodes, f"{MOST_STEPS:,}"
        )
    if agent.cut:
        log.warning(
            "warning: %s: %d of %d actions were beyond its limits, and were cut to them.", name, agent.cut, agent.acted
        )
    return Rollouts(np.array(returns), np.array(lengths))


def started(env, name: str, seed: int):
    """The first observation of an episode of ``env``."""
    return in_their_words(lambda: env.reset(seed=seed)[0], name)


def stepped(env, name: str, action: np.ndarray) -> tuple[Any, float, bool]:
    """Observation, reward and whether the episode is over after a step of ``env``. Raises `InputError` where it fails."""

    def found() -> tuple[Any, float, bool]:
        observation, reward, ended, cut, _ = env.step(action)
        return observation, float(reward), bool(ended or cut)

    observation, reward, over = in_their_words(found, name)
    if not math.isfinite(reward):
        raise InputError(f"{name} gave the reward {reward}, but must give finite numbers.")
    return observation, reward, over


def _picture(env, name: str) -> np.ndarray:
    try:
        picture = np.asarray(env.render())
    except Exception as error:  # whatever a stranger's environment may raise
        raise InputError(f"{name} cannot be drawn here: {first_line(error)}.") from None
    if picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise InputError(f"{name} gives no pictures (its render gave shape {picture.shape}); leave video out.")
    return picture[..., :3].astype(np.uint8)


def save_gif(path: Path, frames: list[np.ndarray], rate: float) -> None:
    """Write ``frames`` as a GIF of ``rate`` pictures a second."""
    images = [Image.fromarray(frame) for frame in frames]
    options: dict[str, Any] = dict(save_all=True, append_images=images[1:], duration=round(1000.0 / rate), loop=0)
    write_atomically(path, lambda temporary: images[0].save(temporary, format="GIF", **options))
