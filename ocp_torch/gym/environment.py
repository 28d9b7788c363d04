"""A problem as a Gymnasium environment; needs the optional extra `gym`. Registered under its name by `ocp_torch.gym`."""

import math
from importlib.util import find_spec

import numpy as np
import torch

from ocp_torch.errors import InputError, require_choice, require_number, shown
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import MARGIN, Problem
from ocp_torch.problems.starts import drawn_starts, starts_narrowly
from ocp_torch.runs.canvas import blank_figure, drawn

# Tries of the rejection sampling of a start, at most; `mu0` has mean 1 and is not narrow, so that few are needed.
MOST_TRIES = 10_000
# Where `mu0` is narrow, episodes start at one of so many draws from it.
DRAWN_STARTS = 4096
# Elsewhere, states among which the largest value of `mu0` is sought.
CANDIDATES = 4096
# Default time for which a control is held, in units of 1 / rho.
HELD = 0.1
# Default length of an episode, in units of 1 / rho.
LENGTH = 5.0
# A time step is divided into parts until half as long ones end this near, in turns on average: one part is off by less for a
# pendulum, but by 0.2 for an acrobot and by 0.1 for the mountain car.
CLOSE = 2e-3
TRIED = 64  # random states and controls of that average
MOST_PARTS = 64
# Coordinates that are drawn as hands of clocks, at most.
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


Env = require_gymnasium().Env if find_spec("gymnasium") is not None else object


class ControlEnvironment(Env):  # type: ignore[misc, valid-type]
    """An environment whose discounted return, with factor `e^{-rho dt}`, is `-Perf` up to the time step.

    Observations are cosine and sine of each coordinate, actions in `[-1, 1]^m` are controls in units of
    ``control_bound`` (default: what the problem knows of `sup |u*|`), within the problem's own limits; one step holds the
    control for ``time_step`` (units of time) with one midpoint step, or several where states move fast, and the reward is
    minus the cost of that step. Noise is added as Euler and Maruyama do, from the environment's own generator.
    Episodes are cut, not ended, after ``horizon``. Of a `System`, ``info`` has the state, and the control of the step, in
    physical units as well, and ``metadata`` the names and units of both. Raises `InputError` for wrong numbers, and for a
    data set.
    """

    metadata: dict = {"render_modes": ["rgb_array"], "render_fps": 15}

    def __init__(
        self,
        problem: Problem,
        control_bound: float | None = None,
        time_step: float | None = None,
        horizon: float | None = None,
        seed: int = 0,
        render_mode: str | None = None,
    ) -> None:
        if not problem.has_simulator:
            raise InputError("a data set cannot be simulated, so it is no environment.")
        self.problem, self.render_mode = problem, render_mode
        bound = resolve_constants(problem).C_u if control_bound is None else control_bound
        # A number, or one for each actuator.
        self.control_bound = np.minimum(require_number("control_bound", bound, above=0.0), problem.control_cost.sides)
        self.time_step = HELD / problem.discount if time_step is None else time_step
        self.horizon = LENGTH / problem.discount if horizon is None else horizon
        require_number("time_step", self.time_step, above=0.0)
        require_number("horizon", self.horizon, above=0.0)
        if render_mode is not None:
            require_choice("render_mode", render_mode, ("rgb_array",))
        if isinstance(problem, System):
            names = {
                "coordinates": [c.label for c in problem.coordinates],
                "controls": [c.label for c in problem.controls],
            }
            self.metadata = {**self.metadata, **names}
        box = require_gymnasium().spaces.Box
        self.observation_space = box(-1.0, 1.0, (2 * problem.dim,), np.float32)
        self.action_space = box(-1.0, 1.0, (problem.control_dim,), np.float32)
        self.generator = torch.Generator().manual_seed(derive_seed(seed, Branch.EPISODES))
        fixed = fixed_generator()
        candidates = torch.rand(CANDIDATES, problem.dim, dtype=torch.float64, generator=fixed)
        narrow = starts_narrowly(problem)
        # The same ones in each environment: which of them an episode has is then a matter of its seed alone.
        self._drawn = drawn_starts(problem, DRAWN_STARTS, derive_seed(0, Branch.EPISODES)) if narrow else None
        self._ceiling = MARGIN * float(problem.initial_density(candidates).max())
        self._weight = -math.expm1(-problem.discount * self.time_step)
        actions = 2.0 * torch.rand(TRIED, problem.control_dim, dtype=torch.float64, generator=fixed) - 1.0
        self._parts = self._enough_parts(candidates[:TRIED], self._controls(actions))
        self.x, self.elapsed = torch.full((1, problem.dim), 0.5, dtype=torch.float64), 0.0

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        if seed is not None:
            self.generator.manual_seed(derive_seed(seed, Branch.EPISODES))
        self.x, self.elapsed = self._start(), 0.0
        return observe(self.x), self._info()

    def _info(self, u: torch.Tensor | None = None) -> dict:
        """The state; for a `System` also in physical units, with the control ``u`` ``(1, m)`` that led to it."""
        found = {"state": self.x[0].numpy().copy()}
        if isinstance(problem := self.problem, System):
            found["physical_state"] = problem.from_torus(self.x)[0].numpy()
            found |= {} if u is None else {"physical_control": problem.from_controls(u)[0].numpy()}
        return found

    def _start(self) -> torch.Tensor:
        """A state ``(1, d)`` drawn from `mu0`."""
        if self._drawn is not None:
            return self._drawn[torch.randint(len(self._drawn), (1,), generator=self.generator)]
        for _ in range(MOST_TRIES):
            x = torch.rand(1, self.problem.dim, dtype=torch.float64, generator=self.generator)
            level = torch.rand((), dtype=torch.float64, generator=self.generator)
            if level * self._ceiling <= self.problem.initial_density(x)[0]:
                break
        return x

    def step(self, action):
        u = self._controls(self._action(action))
        self.x, costs = self._moved(self.x, u, self._parts, noisy=True)
        discounts = torch.exp(
            -self.problem.discount * self.time_step / self._parts * torch.arange(self._parts).double()
        )
        cost = float((discounts / discounts.sum()) @ costs[:, 0])
        self.elapsed += self.time_step
        done = self.elapsed >= self.horizon * (1.0 - 1e-9)
        return observe(self.x), -self._weight * cost, False, done, {**self._info(u), "cost": cost}

    def _action(self, action) -> torch.Tensor:
        """``action`` as ``(1, m)``. Raises `InputError` where it is not as many finite numbers."""
        count = self.problem.control_dim
        try:
            given = np.asarray(action, dtype=np.float64).reshape(1, count)
        except (TypeError, ValueError):
            given = np.full((1, count), np.nan)
        if not np.isfinite(given).all():
            raise InputError(f"action is {shown(action)}, but must be {count} finite number{'s' if count > 1 else ''}.")
        return torch.from_numpy(given)

    def _controls(self, actions: torch.Tensor) -> torch.Tensor:
        """The controls ``(N, m)`` of ``actions``."""
        controls = torch.as_tensor(self.control_bound) * actions.clamp(-1.0, 1.0)
        return self.problem.control_cost.within(controls, torch.ones(1, dtype=torch.float64))

    def _moved(
        self, x: torch.Tensor, u: torch.Tensor, parts: int, noisy: bool = False
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """States ``(N, d)`` after one time step of ``parts`` midpoint steps under controls ``(N, m)``, and the cost in each
        of these, ``(parts, N)``."""
        h, costs = self.time_step / parts, []
        for _ in range(parts):
            middle = x + 0.5 * h * self.problem.velocity(x, u)
            velocity, cost = self.problem.motion(middle, u)
            x = (x + h * velocity + (self._kick(x, h) if noisy else 0.0)).remainder(1.0)
            costs.append(cost)
        return x, torch.stack(costs)

    def _enough_parts(self, x: torch.Tensor, u: torch.Tensor) -> int:
        """Into how many midpoint steps a time step is divided."""
        parts, ends = 1, self._moved(x, u, 1)[0]
        while parts < MOST_PARTS:
            finer = self._moved(x, u, 2 * parts)[0]
            if float(((finer - ends + 0.5).remainder(1.0) - 0.5).norm(dim=1).mean()) <= CLOSE:
                break
            parts, ends = 2 * parts, finer
        return parts

    def _kick(self, x: torch.Tensor, h: float) -> torch.Tensor | float:
        """`sigma dW` over a time ``h`` from the state ``x`` on, ``(1, d)``; 0 where there is no noise."""
        if (sigma := self.problem.noise(x)) is None:
            return 0.0
        moves = torch.randn(sigma.shape[-1], dtype=torch.float64, generator=self.generator)
        return math.sqrt(h) * (sigma @ moves)

    def render(self):
        return clocks(self.x[0]) if self.render_mode == "rgb_array" else None

    # The translation that an agent made for the problem needs.
    def from_observation(self, observation: np.ndarray) -> np.ndarray:
        return state_of(observation)

    def to_action(self, control: np.ndarray) -> np.ndarray:
        return np.clip(np.asarray(control) / self.control_bound, -1.0, 1.0).astype(np.float32)


def observe(x: torch.Tensor) -> np.ndarray:
    """Cosine and sine of each coordinate, ``(N, 2 d)`` or, for one state, ``(2 d,)``, float32."""
    angles = 2.0 * math.pi * x
    return torch.cat([angles.cos(), angles.sin()], dim=-1).squeeze(0).to(torch.float32).numpy()


def state_of(observation: np.ndarray) -> np.ndarray:
    """The state in `[0, 1)^d` of an ``observation`` ``(..., 2 d)``: the inverse of `observe`."""
    cosine, sine = np.split(np.asarray(observation, dtype=np.float64), 2, axis=-1)
    return np.arctan2(sine, cosine) / (2.0 * np.pi) % 1.0


def clocks(x: torch.Tensor) -> np.ndarray:
    """A picture ``(height, width, 3)``, uint8, of a state ``(d,)``: each coordinate is the hand of a clock."""
    count = min(len(x), MOST_CLOCKS)
    columns = math.ceil(math.sqrt(count))
    rows = math.ceil(count / columns)
    figure = blank_figure(1.6 * columns, 1.6 * rows, dpi=80, layout="tight")
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for i, axis in enumerate(axes[:count]):
        angle = 2.0 * math.pi * float(x[i])
        axis.plot(np.cos(turn), np.sin(turn), "C7", linewidth=1.0)
        axis.plot([0.0, math.cos(angle)], [0.0, math.sin(angle)], "C0", linewidth=3.0)
        axis.set(aspect="equal", title=f"$x_{{{i + 1}}}$", xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    return drawn({"clocks": figure})["clocks"]
