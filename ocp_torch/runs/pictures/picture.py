"""A system in motion under a controller, beside the same starts with no control: in one figure, or as an animated GIF."""

from pathlib import Path as FilePath

from ocp_torch.control.policies import Policy, zero_policy
from ocp_torch.errors import InputError, StorageError
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.problem import Problem
from ocp_torch.runs.canvas import Figure, blank_figure
from ocp_torch.runs.metrics.measures import Path, simulate
from ocp_torch.runs.metrics.trial import random_starts
from ocp_torch.runs.pictures.scenes import Scene, scene

# Time drawn, in units of 1 / rho, and frames of it.
DURATION, FRAMES = 5.0, 160
# Of a panel, in inches.
WIDTH, HEIGHT = 4.6, 4.2
# Of an animation, every fourth frame, coarsely: a GIF of a few hundred kilobytes.
FRAMES_PER_SECOND, STRIDE, DPI = 12, 4, 60


def _panels(problem: Problem, look: Scene, policy: Policy, seed: int) -> list[tuple[str, Path]]:
    """Titles and paths from random admissible starts: each apart, or all in one panel beside the same without control."""
    x0 = random_starts(problem, look.starts, derive_seed(seed, Branch.PICTURES))
    run = lambda each, starts: simulate(problem, each, starts, DURATION / problem.discount, FRAMES)
    if look.apart:
        return [("", run(policy, start)) for start in x0.split(1)]
    return [("controlled", run(policy, x0)), ("no control", run(zero_policy(problem), x0))]


def _draw(figure: Figure, problem: Problem, look: Scene, panels: list[tuple[str, Path]], frame: int) -> None:
    """All panels up to ``frame``, on a cleared ``figure``."""
    figure.clear()
    axes = figure.subplots(1, len(panels), squeeze=False, subplot_kw={"projection": look.projection})[0]
    for one, (title, path) in zip(axes, panels, strict=True):
        look.draw(problem, one, path, frame)
        one.set_title(f"{title}  {one.get_title()}".strip(), fontsize="medium")


def motion(problem: Problem, policy: Policy, seed: int = 0) -> Figure | None:
    """The whole motion in one figure; `None` for problems without a scene."""
    look = scene(problem)
    if look is None:
        return None
    panels = _panels(problem, look, policy, seed)
    figure = blank_figure(WIDTH * len(panels), HEIGHT)
    _draw(figure, problem, look, panels, FRAMES)
    return figure


def require_gif(problem: Problem, path: object) -> FilePath:
    """``path`` if it ends in `.gif` and ``problem`` has a scene; `InputError` otherwise."""
    if FilePath(str(path)).suffix != ".gif":
        raise InputError(f"animation is {str(path)!r}, but must be a file that ends in .gif.")
    if scene(problem) is None:
        raise InputError(f"animation is {str(path)!r}, but {type(problem).__name__} has no picture that moves.")
    return FilePath(str(path))


def animate(problem: Problem, policy: Policy, path: str | FilePath, seed: int = 0) -> FilePath:
    """Write the motion of ``problem`` under ``policy`` as ``path``, a `.gif`; `InputError` for another suffix or a problem
    without a scene, `StorageError` for a file that cannot be written."""
    from matplotlib.animation import PillowWriter

    path, look = require_gif(problem, path), scene(problem)
    assert look is not None  # as was just required
    panels = _panels(problem, look, policy, seed)
    figure, writer = blank_figure(WIDTH * len(panels), HEIGHT), PillowWriter(fps=FRAMES_PER_SECOND)
    figure.set_layout_engine("none")  # the same axes in every frame, and not found anew for each
    try:
        with writer.saving(figure, str(path), dpi=DPI):
            for frame in range(0, FRAMES + 1, STRIDE):
                _draw(figure, problem, look, panels, frame)
                writer.grab_frame()
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error.strerror or error}.") from None
    return path
