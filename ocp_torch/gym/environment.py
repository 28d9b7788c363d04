"""A problem as a Gymnasium environment; needs the optional extra `gym`. Registered under its name by `ocp_torch.gym`."""

import math
from functools import cache
from typing import Any

import numpy as np
import torch

from ocp_torch.errors import InputError, require_choice, require_number
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import drawn_starts, starts_narrowly
from ocp_torch.runs.canvas import blank_figure

# Rejections at most for one start: `mu0` has mean 1, so that a bound of its supremum is met soon.
MOST_TRIES = 10_000
# Where `mu0` is narrow episodes start at one of so many draws from it.
DRAWN_STARTS = 4096
# By default a control is held for this part of the discount time `1 / rho`, and an episode takes so many of them.
HELD, LENGTH = 0.1, 5.0
# Coordinates drawn, as hands of clocks.
MOST_CLOCKS = 12


def require_gymnasium():
    """The module `gymnasium`, or an `InputError` that says how to get it."""
    try:
        import gymnasium
    except ImportError as error:
        raise InputError(
            f'environments need a package that is not installed ({error.name}); get it with pip install -e ".[gym]".'
        ) from None
    return gymnasium


def make_environment(
    problem: Problem,
    control_bound: float | None = None,
    time_step: float | None = None,
    horizon: float | None = None,
    seed: int = 0,
    render_mode: str | None = None,
):
    """An environment whose discounted return, with factor `e^{-rho dt}`, is `-Perf` up to the time step.

    Observations are cosine and sine of each coordinate, actions in `[-1, 1]^m` are controls in units of
    ``control_bound`` (default: what the problem knows of `sup |u*|`), within the problem's own limit; one step holds the
    control for ``time_step`` (units of time) with one midpoint step, and the reward is minus the cost of that step.
    Episodes are cut, not ended, after ``horizon``. Raises `InputError` for wrong numbers, and for a data set.
    """
    if not problem.has_simulator:
        raise InputError("a data set cannot be simulated, so it is no environment.")
    if control_bound is None:
        control_bound = resolve_constants(problem).C_u
    if problem.control_limit is not None:
        control_bound = min(control_bound, problem.control_limit)
    time_step = HELD / problem.discount if time_step is None else time_step
    horizon = LENGTH / problem.discount if horizon is None else horizon
    require_number("rl.time_step", time_step, above=0.0)
    require_number("rl.horizon", horizon, above=0.0)
    require_number("control_bound", control_bound, above=0.0)
    if render_mode is not None:
        require_choice("render_mode", render_mode, ("rgb_array",))
    return _environment_class()(problem, control_bound, time_step, horizon, seed, render_mode)


@cache
def _environment_class() -> type:
    """The class, made when Gymnasium is there."""
    gymnasium = require_gymnasium()

    class ControlEnvironment(gymnasium.Env):  # type: ignore[name-defined]
        metadata: dict = {"render_modes": ["rgb_array"], "render_fps": 15}

        def __init__(self, problem, control_bound, time_step, horizon, seed, render_mode) -> None:
            self.problem, self.control_bound, self.render_mode = problem, control_bound, render_mode
            self.time_step, self.horizon = time_step, horizon
            self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2 * problem.dim,), np.float32)
            self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (problem.control_dim,), np.float32)
            self.generator = torch.Generator().manual_seed(derive_seed(seed, Branch.EPISODES))
            candidates = torch.rand(4096, problem.dim, dtype=torch.float64, generator=fixed_generator())
            narrow = starts_narrowly(problem)
            self._drawn = drawn_starts(problem, DRAWN_STARTS, derive_seed(seed, Branch.EPISODES)) if narrow else None
            self._ceiling = 1.05 * float(problem.initial_density(candidates).max())
            self._weight = -math.expm1(-problem.discount * time_step)
            self.x, self.elapsed = torch.full((1, problem.dim), 0.5, dtype=torch.float64), 0.0

        def reset(self, *, seed: int | None = None, options: dict | None = None):
            super().reset(seed=seed)
            if seed is not None:
                self.generator.manual_seed(derive_seed(seed, Branch.EPISODES))
            self.elapsed = 0.0
            if self._drawn is not None:
                self.x = self._drawn[torch.randint(len(self._drawn), (1,), generator=self.generator)]
                return observe(self.x), {"state": self.x[0].numpy()}
            for _ in range(MOST_TRIES):
                self.x = torch.rand(1, self.problem.dim, dtype=torch.float64, generator=self.generator)
                level = torch.rand((), dtype=torch.float64, generator=self.generator)
                if level * self._ceiling <= self.problem.initial_density(self.x)[0]:
                    break
            return observe(self.x), {"state": self.x[0].numpy()}

        def step(self, action):
            problem, h = self.problem, self.time_step
            u = torch.as_tensor(np.asarray(action), dtype=torch.float64).reshape(1, -1).clamp(-1.0, 1.0)
            u = problem.control_cost.within(self.control_bound * u, torch.ones(1, dtype=torch.float64))
            middle = self.x + 0.5 * h * problem.velocity(self.x, u)
            cost = float(problem.state_cost(middle) + problem.control_cost.cost(u))
            self.x = (self.x + h * problem.velocity(middle, u)).remainder(1.0)
            self.elapsed += h
            done = self.elapsed >= self.horizon * (1.0 - 1e-9)
            return observe(self.x), -self._weight * cost, False, done, {"state": self.x[0].numpy(), "cost": cost}

        def render(self):
            return clocks(self.x[0]) if self.render_mode == "rgb_array" else None

        # What an agent made for the problem needs to know of its environment.
        from_observation = staticmethod(state_of)

        def to_action(self, control: np.ndarray) -> np.ndarray:
            return np.clip(np.asarray(control) / self.control_bound, -1.0, 1.0).astype(np.float32)

    return ControlEnvironment


def observe(x: torch.Tensor) -> np.ndarray:
    """Cosine and sine of each coordinate, ``(N, 2 d)`` or, for one state, ``(2 d,)``, float32."""
    angles = 2.0 * math.pi * x
    return torch.cat([angles.cos(), angles.sin()], dim=-1).squeeze(0).to(torch.float32).numpy()


def state_of(observation: np.ndarray) -> np.ndarray:
    """The state in `[0, 1)^d` that `observe` turned into ``observation`` ``(..., 2 d)``."""
    cosine, sine = np.split(np.asarray(observation, dtype=np.float64), 2, axis=-1)
    return np.arctan2(sine, cosine) / (2.0 * np.pi) % 1.0


def clocks(x: torch.Tensor) -> np.ndarray:
    """A picture ``(height, width, 3)``, uint8, of a state ``(d,)``: each coordinate is the hand of a clock."""
    count = min(len(x), MOST_CLOCKS)
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    figure = blank_figure(1.6 * columns, 1.6 * rows, dpi=80, layout="tight")
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    for i, axis in enumerate(figure.subplots(rows, columns, squeeze=False).flat):
        axis.set_axis_off()
        if i >= count:
            continue
        angle = 2.0 * math.pi * float(x[i])
        axis.plot(np.cos(turn), np.sin(turn), "C7", linewidth=1.0)
        axis.plot([0.0, math.cos(angle)], [0.0, math.sin(angle)], "C0", linewidth=3.0)
        axis.set(aspect="equal", title=f"$x_{{{i + 1}}}$", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    figure.canvas.draw()
    canvas: Any = figure.canvas  # that of Agg, which has its pixels
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
