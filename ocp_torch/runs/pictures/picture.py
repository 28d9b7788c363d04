"""A system in motion under a controller, beside the same starts with no control."""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch
from typing import TYPE_CHECKING

from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.planar import PlanarVehicle
from ocp_torch.runs.metrics.trajectories import Path, simulate
from ocp_torch.runs.metrics.trial import random_starts
from ocp_torch.runs.pictures.scenes import Scene, projection, scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Time drawn, in units of 1 / rho, and frames of it.
DURATION, FRAMES = 5.0, 160
# Starts drawn in one panel, of oscillators and of vehicles and pendulums; of arms, one in a panel.
OSCILLATORS, TRACKS, ARMS = 24, 6, 3


@dataclass(frozen=True)
class Moving:
    """Panels of a picture: for each its title, how it draws, and the path it draws; on axes of one ``projection``."""

    panels: list[tuple[str, Scene, Path]]
    projection: str

    def draw(self, figure: Figure, frame: int) -> None:
        """All panels up to ``frame``, on a cleared ``figure``."""
        figure.clear()
        axes = figure.subplots(1, len(self.panels), squeeze=False, subplot_kw={"projection": self.projection})[0]
        for one, (title, draw, path) in zip(axes, self.panels, strict=True):
            draw(one, path, frame)
            one.set_title(f"{title}  {one.get_title()}".strip(), fontsize="medium")

    def figure(self) -> Figure:
        """An empty figure of the right size."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(4.6 * len(self.panels), 4.2), layout="constrained")
        FigureCanvasAgg(figure)
        return figure


@singledispatch
def starts_drawn(problem: Problem) -> tuple[int, bool]:
    """How many starts are drawn, and whether each has a panel of its own."""
    return OSCILLATORS, False


@starts_drawn.register
def _(problem: Linkage) -> tuple[int, bool]:
    return ARMS, True


@starts_drawn.register(PlanarVehicle)
@starts_drawn.register(Pendulum)
def _(problem) -> tuple[int, bool]:
    return TRACKS, False


def moving(problem: Problem, policy: Policy, seed: int = 0) -> Moving | None:
    """``problem`` under ``policy`` from random admissible starts; beside it, where they share a panel, without control."""
    draw = scene(problem)
    if draw is None:
        return None
    count, apart = starts_drawn(problem)
    x0 = random_starts(problem, count, derive_seed(seed, Branch.PICTURES))
    duration = DURATION / problem.discount
    if apart:
        paths = [simulate(problem, policy, x0[i : i + 1], duration, FRAMES) for i in range(count)]
        return Moving([("", draw, path) for path in paths], projection(problem))
    titles = {"controlled": policy, "no control": zero_policy(problem)}
    panels = [(t, draw, simulate(problem, each, x0, duration, FRAMES)) for t, each in titles.items()]
    return Moving(panels, projection(problem))


def motion(problem: Problem, policy: Policy, seed: int = 0) -> Figure | None:
    """The whole motion in one figure; `None` for problems without a scene."""
    shown = moving(problem, policy, seed)
    if shown is None:
        return None
    figure = shown.figure()
    shown.draw(figure, FRAMES)
    return figure


def practical_figures(problem: Problem, policy: Policy, seed: int) -> dict[str, Figure]:
    """`motion`, by its name in a run's folder, for problems that have a scene."""
    figure = motion(problem, policy, seed)
    return {} if figure is None else {"motion": figure}
