"""The same picture, moving: an animated GIF through Pillow, which Matplotlib brings along."""

from __future__ import annotations

from pathlib import Path as FilePath

from ocp_torch.control.policies import Policy
from ocp_torch.errors import InputError, StorageError
from ocp_torch.problems.problem import Problem
from ocp_torch.runs.pictures.picture import FRAMES, moving
from ocp_torch.runs.pictures.scenes import scene

# Every fourth frame of the path, coarsely: a GIF of a few hundred kilobytes.
FRAMES_PER_SECOND, STRIDE, DPI = 12, 4, 60


def require_gif(problem: Problem, path: object) -> FilePath:
    """``path`` if it ends in `.gif` and ``problem`` has a scene; `InputError` otherwise."""
    if FilePath(str(path)).suffix != ".gif":
        raise InputError(f"animation is {str(path)!r}, but must be a file that ends in .gif.")
    if scene(problem) is None:
        raise InputError(f"animation is {str(path)!r}, but {type(problem).__name__} has no picture that moves.")
    return FilePath(str(path))


def animate(problem: Problem, policy: Policy, path: str | FilePath, seed: int = 0) -> FilePath:
    """Write the motion of ``problem`` under ``policy`` as ``path``, a `.gif`.

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
