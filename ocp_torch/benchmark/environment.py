"""One of our problems as a Gymnasium environment, for reinforcement learning; needs the optional extra `rl`."""

from __future__ import annotations

import math

import numpy as np
import torch

from ocp_torch.errors import InputError, require_number
from ocp_torch.problems.problem import Problem
from ocp_torch.samplers import derive_seed

# Branch of the seed tree for initial states of episodes, beside those of training.
EPISODE_STREAM = 4
# Rejections at most for one start: `mu0` has mean 1, so that a bound of its supremum is met soon.
MOST_TRIES = 10_000


def require_rl() -> tuple:
    """The modules `gymnasium` and `stable_baselines3`, or an `InputError` that says how to get them."""
    try:
        import gymnasium
        import stable_baselines3
    except ImportError as error:
        raise InputError(
            f'SAC and PPO need packages that are not installed ({error.name}); get them with pip install -e ".[rl]".'
        ) from None
    return gymnasium, stable_baselines3


def make_environment(problem: Problem, control_bound: float, time_step: float, horizon: float, seed: int):
    """An environment whose discounted return, with factor `e^{-rho dt}`, is `-Perf` up to the time step.

    Observations are cosine and sine of each coordinate, actions in `[-1, 1]^m` are controls in units of
    ``control_bound``; one step holds the control for ``time_step`` (units of time) with one midpoint step, and the reward
    is minus the cost of that step. Episodes are cut, not ended, after ``horizon``.
    """
    gymnasium, _ = require_rl()
    require_number("rl.time_step", time_step, above=0.0)
    require_number("rl.horizon", horizon, above=0.0)
    weight = -math.expm1(-problem.discount * time_step)
    candidates = torch.rand(4096, problem.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    ceiling = 1.05 * float(problem.initial_density(candidates).max())

    class ControlEnvironment(gymnasium.Env):
        metadata: dict = {"render_modes": []}

        def __init__(self) -> None:
            self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2 * problem.dim,), np.float32)
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (problem.control_dim,), np.float32)
            self.generator = torch.Generator().manual_seed(derive_seed(seed, EPISODE_STREAM))
            self.x, self.elapsed = torch.full((1, problem.dim), 0.5, dtype=torch.float64), 0.0

        def reset(self, *, seed: int | None = None, options: dict | None = None):
            super().reset(seed=seed)
            if seed is not None:
                self.generator.manual_seed(derive_seed(seed, EPISODE_STREAM))
            self.elapsed = 0.0
            for _ in range(MOST_TRIES):
                self.x = torch.rand(1, problem.dim, dtype=torch.float64, generator=self.generator)
                level = torch.rand((), dtype=torch.float64, generator=self.generator)
                if level * ceiling <= problem.initial_density(self.x)[0]:
                    break
            return observe(self.x), {}

        def step(self, action):
            u = control_bound * torch.as_tensor(np.asarray(action), dtype=torch.float64).reshape(1, -1).clamp(-1.0, 1.0)
            middle = self.x + 0.5 * time_step * problem.velocity(self.x, u)
            cost = problem.state_cost(middle) + problem.control_cost.cost(u)
            self.x = (self.x + time_step * problem.velocity(middle, u)).remainder(1.0)
            self.elapsed += time_step
            return observe(self.x), -weight * float(cost), False, self.elapsed >= horizon, {}

    return ControlEnvironment()


def observe(x: torch.Tensor) -> np.ndarray:
    """Cosine and sine of each coordinate, ``(N, 2 d)`` or, for one state, ``(2 d,)``, float32."""
    angles = 2.0 * math.pi * x
    return torch.cat([angles.cos(), angles.sin()], dim=-1).squeeze(0).to(torch.float32).numpy()
