"""A system in motion under a controller, beside the same starts with no control: in one figure, or as an animated GIF."""

from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.errors import InputError, StorageError
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.problem import Problem
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.runs.metrics.measures import Path, simulate
from ocp_torch.runs.metrics.trial import random_starts
from ocp_torch.runs.pictures.scenes import Scene, scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Time drawn, in units of 1 / rho, and frames of it.
DURATION, FRAMES = 5.0, 160
# Of an animation, every fourth frame, coarsely: a GIF of a few hundred kilobytes.
FRAMES_PER_SECOND, STRIDE, DPI = 12, 4, 60


@dataclass(frozen=True)
class Moving:
    """Panels of a picture, each with its title and the path that the ``scene`` of the ``problem`` draws in it."""

    problem: Problem
    scene: Scene
    panels: list[tuple[str, Path]]

    def draw(self, figure: "Figure", frame: int) -> None:
        """All panels up to ``frame``, on a cleared ``figure``."""
        figure.clear()
        axes = figure.subplots(1, len(self.panels), squeeze=False, subplot_kw={"projection": self.scene.projection})[0]
        for one, (title, path) in zip(axes, self.panels, strict=True):
            self.scene.draw(self.problem, one, path, frame)
            one.set_title(f"{title}  {one.get_title()}".strip(), fontsize="medium")

    def figure(self) -> "Figure":
        """An empty figure of the right size."""
        return blank_figure(4.6 * len(self.panels), 4.2)


def moving(problem: Problem, policy: Policy, seed: int = 0) -> Moving | None:
    """``problem`` under ``policy`` from random admissible starts; beside it, where they share a panel, without control."""
    shown = scene(problem)
    if shown is None:
        return None
    x0 = random_starts(problem, shown.starts, derive_seed(seed, Branch.PICTURES))
    run = lambda each, starts: simulate(problem, each, starts, DURATION / problem.discount, FRAMES)
    if shown.apart:
        return Moving(problem, shown, [("", run(policy, start)) for start in x0.split(1)])
    return Moving(problem, shown, [("controlled", run(policy, x0)), ("no control", run(zero_policy(problem), x0))])


def motion(problem: Problem, policy: Policy, seed: int = 0) -> "Figure | None":
    """The whole motion in one figure; `None` for problems without a scene."""
    shown = moving(problem, policy, seed)
    if shown is None:
        return None
    figure = shown.figure()
    shown.draw(figure, FRAMES)
    return figure


def require_gif(problem: Problem, path: object) -> FilePath:
    """``path`` if it ends in `.gif` and ``problem`` has a scene; `InputError` otherwise."""
    if FilePath(str(path)).suffix != ".gif":
        raise InputError(f"animation is {str(path)!r}, but must be a file that ends in .gif.")
    if scene(problem) is None:
        raise InputError(f"animation is {str(path)!r}, but {type(problem).__name__} has no picture that moves.")
    return FilePath(str(path))


def animate(problem: Problem, policy: Policy, path: str | FilePath, seed: int = 0) -> FilePath:
    """Write the motion of ``problem`` under ``policy`` as ``path``, a `.gif`, through Pillow, which Matplotlib brings along.

    Raises `InputError` for another suffix or a problem without a scene, `StorageError` for a file that cannot be written.
    """
    from matplotlib.animation import PillowWriter

    path, shown = require_gif(problem, path), moving(problem, policy, seed)
    assert shown is not None  # there is a scene
    figure, writer = shown.figure(), PillowWriter(fps=FRAMES_PER_SECOND)
    figure.set_layout_engine("none")  # the same axes in every frame, and not found anew for each
    try:
        with writer.saving(figure, str(path), dpi=DPI):
            for frame in range(0, FRAMES + 1, STRIDE):
                shown.draw(figure, frame)
                writer.grab_frame()
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error.strerror or error}.") from None
    return path
