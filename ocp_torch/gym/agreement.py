"""Whether somebody else's environment moves as the model of the controller does: each of its steps beside the model's."""

import numpy as np
import torch
from torch import Tensor

from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem

# Part of its motion by which a coordinate may differ from the model: exact models of Pendulum-v1 and MountainCarContinuous-v0
# differ by 2e-4 at most, a pendulum whose mass or length is 10 % wrong by 0.003 to 0.07, with cosine for sine by 2.
LARGEST_DIFFERENCE = 2e-3
AT_END = 1e-4  # distance from the end of an interval, as a part of half its length, below which a state is at the end
FEWEST_STEPS = 10  # below which more episodes are waited for (not tuned)
ROUNDING = 1e-6  # turns in a step, as observations are in single precision
NOISE_DEVIATIONS = 3.0  # standard deviations of the model's noise that a step may differ by besides (not tuned)


class Agreement:
    """Steps of an environment that holds an action for ``step`` units of time, in which ``problem`` says how states move.

    The mean velocity in a step is between the model's at its start, in its middle and at its end, up to the fourth order of
    the step where the environment is exact, and in all that explicit or implicit steps of the first order give.
    """

    def __init__(self, problem: Problem, step: float, actions) -> None:
        self.problem, self.step, self.actions = problem, step, actions
        self._last: tuple[np.ndarray, np.ndarray] | None = None
        self.steps: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # from, control, to

    def acted(self, state: np.ndarray, control: np.ndarray, action: np.ndarray) -> None:
        """Note the ``state`` ``(d,)`` of the torus at the end of the step before, and the ``control`` ``(m,)`` that the
        ``action`` applies from there on. A step is left out where the environment may apply another control: at a limit
        of its actions, and where it counts them."""
        if self._last is not None:
            self.steps.append((*self._last, state))
        low, high = (getattr(self.actions, side, action) for side in ("low", "high"))
        self._last = (state, control) if bool(((action > low) & (action < high)).all()) else None

    @torch.no_grad()
    def difference(self) -> str | None:
        """Where environment and model differ after an episode, in words; empty where they agree, `None` while too few steps
        are known."""
        self._last = None
        if not self.steps:
            return None
        x, u, y = (torch.as_tensor(np.stack(part), dtype=torch.float64) for part in zip(*self.steps, strict=True))
        kept = self._inside(x) & self._inside(y)
        x, u, y = x[kept], u[kept], y[kept]
        if len(x) < FEWEST_STEPS:
            self.steps = [step for step, inside in zip(self.steps, kept, strict=True) if inside]
            return None
        moved = (y - x + 0.5).remainder(1.0) - 0.5
        model = self.step * torch.stack([self.problem.velocity(at, u) for at in (x, x + 0.5 * moved, y)])
        low, high = model.amin(dim=0), model.amax(dim=0)
        beyond = torch.maximum(low - moved, moved - high) - ROUNDING - NOISE_DEVIATIONS * self._kick(x)
        off = beyond.clamp_min(0.0)
        part = off.sum(dim=0) / moved.abs().sum(dim=0).clamp_min(ROUNDING * len(x))
        i = int(part.argmax())
        if not float(part[i]) > LARGEST_DIFFERENCE:
            return ""
        row = int(off[:, i].argmax())
        ends = (float(v[row, i]) for v in (moved, low, high))
        return f"{self._told(i, *ends)} ({100.0 * float(part[i]):.2g} % of its motion apart on average)"

    def _told(self, i: int, moved: float, low: float, high: float) -> str:
        """How coordinate ``i`` ``moved`` in a step, and from ``low`` to ``high`` in the model, in its unit."""
        name, unit, length = f"coordinate {i}", "turns", 1.0
        if isinstance(self.problem, System):
            c = self.problem.coordinates[i]
            name, unit, length = c.name, c.unit, float(self.problem.chart.length[i])
        says = f"{length * low:.4g}" if high - low < 1e-3 * abs(high) else f"{length * low:.4g} to {length * high:.4g}"
        return f"in a step of {self.step:g} {name} changed by {length * moved:.4g} {unit}, where the model says {says}"

    def _inside(self, x: Tensor) -> Tensor:
        """Whether states ``(N, d)`` are away from the ends of intervals, ``(N,)``: there environments stop or clip motion."""
        if not isinstance(self.problem, System):
            return torch.ones(len(x), dtype=torch.bool)
        chart = self.problem.chart
        return ~chart.outside(chart.centre + (1.0 + AT_END) * (chart.from_torus(x) - chart.centre))

    def _kick(self, x: Tensor) -> Tensor | float:
        """The standard deviation of a step by the noise of the model, ``(N, d)``."""
        sigma = self.problem.noise(x)
        return 0.0 if sigma is None else self.step**0.5 * sigma.norm(dim=-1)
