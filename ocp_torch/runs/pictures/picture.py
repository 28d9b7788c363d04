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

NOISY_STARTS = 3  # starts with noise, at most
SAMPLES = 8  # paths from each start with noise
DURATION = 5.0  # time drawn, in units of 1 / rho
FRAMES = 160  # of this time
WIDTH, HEIGHT = 4.6, 4.2  # of a panel, in inches
# An animation of every fourth frame, at few dots per inch, makes a GIF of a few hundred kilobytes.
STRIDE = 4
DPI = 60
FRAMES_PER_SECOND = 12


def _panels(problem: Problem, look: Scene, policy: Policy, seed: int) -> list[tuple[str, Path]]:
    """Titles and paths from random admissible starts: a panel for each, or one for all beside the same without control."""
    starts = min(look.starts, NOISY_STARTS) if problem.noisy else look.starts
    x0 = random_starts(problem, starts, derive_seed(seed, Branch.PICTURES))
    run = lambda each, starts: simulate(problem, each, starts, DURATION / problem.discount, FRAMES, SAMPLES)
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
    figure.set_layout_engine("none")  # keeps the axes in place from frame to frame
    try:
        with writer.saving(figure, str(path), dpi=DPI):
            for frame in range(0, FRAMES + 1, STRIDE):
                _draw(figure, problem, look, panels, frame)
                writer.grab_frame()
    except OSError as error:
        raise StorageError(f"{path} cannot be written: {error.strerror or error}.") from None
    return path
