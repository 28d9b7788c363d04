"""Episodes of a saved controller in a Gymnasium environment: played, printed and filmed."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ocp_torch.control.controller import Controller
from ocp_torch.errors import InputError, require_integer
from ocp_torch.files.storage import write_atomically
from ocp_torch.gym.agent import Agent
from ocp_torch.gym.environment import require_gymnasium
from ocp_torch.runs.evaluate import load_run

log = logging.getLogger(__name__)

# Frames of a video at most, and steps of an episode: an environment may have no end.
MOST_FRAMES, MOST_STEPS = 600, 100_000


@dataclass(frozen=True)
class Rollouts:
    """Undiscounted ``returns`` and ``lengths`` per episode."""

    returns: np.ndarray
    lengths: np.ndarray

    @property
    def mean(self) -> float:
        return float(self.returns.mean())

    @property
    def se(self) -> float:
        """Standard error of the mean; 0 for one episode."""
        count = len(self.returns)
        return float(self.returns.std(ddof=1) / math.sqrt(count)) if count > 1 else 0.0

    def __str__(self) -> str:
        low, high = self.returns.min(), self.returns.max()
        return (
            f"return {self.mean:.6g} ± {self.se:.2g} (standard error of {len(self.returns)} episodes), from {low:.6g} to "
            f"{high:.6g}; {self.lengths.mean():.1f} steps each"
        )


@dataclass(frozen=True)
class RolloutJob:
    """What was asked for, checked."""

    controller: Controller
    env: str
    episodes: int
    seed: int
    video: Path | None

    def run(self) -> Rollouts:
        """Play, print, and draw."""
        env = made(self.env, None)
        try:
            found = play(self.controller, env, self.env, self.episodes, self.seed)
        finally:
            env.close()
        log.info("%s: %s", self.env, found)
        if self.video is not None:
            self._film(self.video)
        return found

    def _film(self, video: Path) -> None:
        """The first episode again, with pictures."""
        env = made(self.env, "rgb_array")
        frames: list[np.ndarray] = []
        try:
            play(self.controller, env, self.env, 1, self.seed, frames)
            rate = env.metadata.get("render_fps", 15)
        finally:
            env.close()
        save_gif(video, frames, rate)
        log.info("%d frames in %s", len(frames), video)


def made(name: str, render_mode: str | None):
    """The environment ``name``. Raises `InputError` where Gymnasium has none, or cannot make it here."""
    gymnasium = require_gymnasium()
    import ocp_torch.gym  # noqa: F401 (registers ours)

    try:
        return gymnasium.make(name, **({} if render_mode is None else {"render_mode": render_mode}))
    except InputError:
        raise
    except Exception as error:  # whatever a stranger's environment may raise
        reason = next(iter(str(error).splitlines()), "no message").rstrip(".?!")
        raise InputError(f"env is {name!r}, which cannot be made: {reason}.") from None


def play(controller: Controller, env, name: str, episodes: int, seed: int, frames: list | None = None) -> Rollouts:
    """``episodes`` of them, seeded ``seed``, ``seed + 1``, ...; pictures of all states are put into ``frames``."""
    agent = Agent(controller, env, name)
    returns, lengths = [], []
    for k in range(episodes):
        observation, _ = env.reset(seed=seed + k)
        total, count, over = 0.0, 0, False
        while not over and count < MOST_STEPS:
            if frames is not None and len(frames) < MOST_FRAMES:
                frames.append(_picture(env, name))
            observation, reward, ended, cut, _ = env.step(agent.act(observation))
            total, count, over = total + float(reward), count + 1, ended or cut
        returns.append(total)
        lengths.append(count)
    return Rollouts(np.array(returns), np.array(lengths))


def _picture(env, name: str) -> np.ndarray:
    try:
        picture = np.asarray(env.render())
    except Exception as error:  # whatever a stranger's environment may raise
        reason = next(iter(str(error).splitlines()), "no message").rstrip(".?!")
        raise InputError(f"{name} cannot be drawn here: {reason}.") from None
    if picture.ndim != 3 or picture.shape[2] not in (3, 4):
        raise InputError(f"{name} gives no pictures (its render gave shape {picture.shape}); leave video out.")
    return picture[..., :3].astype(np.uint8)


def save_gif(path: Path, frames: list[np.ndarray], rate: float) -> None:
    """Write ``frames`` as a GIF of ``rate`` pictures a second."""
    images = [Image.fromarray(frame) for frame in frames]
    options: dict[str, Any] = dict(save_all=True, append_images=images[1:], duration=round(1000.0 / rate), loop=0)
    write_atomically(path, lambda temporary: images[0].save(temporary, format="GIF", **options))


def rollout_job(config: dict) -> RolloutJob:
    """Check every field. Raises `InputError` for a wrong one."""
    controller = load_run(config)
    video = None if config["video"] is None else Path(str(config["video"]))
    if video is not None and video.suffix != ".gif":
        raise InputError(f"video is {str(video)!r}, but must be a file whose name ends in .gif.")
    name = str(config["env"])
    env = made(name, None)
    try:
        Agent(controller, env, name).act(env.reset(seed=0)[0])
    finally:
        env.close()
    episodes = require_integer("episodes", config["episodes"], 1, maximum=10**6)
    return RolloutJob(controller, name, episodes, require_integer("seed", config["seed"], 0), video)
