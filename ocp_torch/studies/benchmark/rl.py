"""SAC and PPO of Stable-Baselines3 as contenders; need the optional extra `rl`."""

import math
import time
from dataclasses import dataclass

import numpy as np
import torch

from ocp_torch.certificate import CertificateSettings
from ocp_torch.errors import InputError, require_integer
from ocp_torch.gym.environment import make_environment, observe
from ocp_torch.problems import Problem
from ocp_torch.studies.benchmark.measure import Curve, Judge, Point, due


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


@dataclass(frozen=True)
class RLContender:
    """``name`` is sac or ppo with the library's defaults; actions reach ``control_bound``, as all methods may know."""

    name: str
    problem: Problem
    control_bound: float
    steps: int
    time_step: float
    horizon: float

    def __post_init__(self) -> None:
        require_integer(f"rl.steps.{self.name}", self.steps, 1)

    def run(self, seed: int, judge: Judge, settings: CertificateSettings) -> Curve:
        """Learn for ``steps`` transitions; the policy is simulated in continuous time like every other controller."""
        _, sb3 = require_rl()
        environment = make_environment(self.problem, self.control_bound, self.time_step, self.horizon, seed)
        discount = math.exp(-self.problem.discount * self.time_step)
        made = {"sac": sb3.SAC, "ppo": sb3.PPO}[self.name]
        model = made("MlpPolicy", environment, gamma=discount, seed=seed, device="cpu", verbose=0)
        points, spent = [], 0.0
        for count in due(500):
            started = time.process_time()
            model.learn(min(count, self.steps) - model.num_timesteps, reset_num_timesteps=False)
            spent += time.process_time() - started
            perf = judge.performance(self.policy(model))
            points.append(Point(model.num_timesteps, spent, {"policy": perf}))
            if model.num_timesteps >= self.steps:
                break
        return Curve(self.name, seed, points)

    def policy(self, model):
        """The deterministic policy as a policy ``(N, d) -> (N, m)``."""

        def control(x: torch.Tensor) -> torch.Tensor:
            observations = np.atleast_2d(observe(x))
            actions, _ = model.predict(observations, deterministic=True)
            u = self.control_bound * torch.from_numpy(np.asarray(actions)).to(x)
            return self.problem.control_cost.within(u, torch.ones_like(x[:, 0]))

        return control
