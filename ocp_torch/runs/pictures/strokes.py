"""Parts of all scenes: obstacles in the plane and in space, and the tracks of paths."""

import math
from typing import Any

import numpy as np
from torch import Tensor

from ocp_torch.runs.metrics.measures import Path


def draw_obstacles(axes: Any, discs: list, clearance: float, period: float | None = None) -> None:
    from matplotlib.patches import Circle

    shifts = [0.0] if period is None else [-period, 0.0, period]
    for x, y, radius in discs:
        for dx in shifts:
            for dy in shifts:
                axes.add_patch(Circle((x + dx, y + dy), radius, color="0.45"))
                axes.add_patch(Circle((x + dx, y + dy), radius + clearance, fill=False, color="0.7", linestyle=":"))


def draw_balls(axes: Any, balls: list, clearance: float) -> None:
    """Draw balls ``[x, y, z, radius]`` in space, and the surface at the ``clearance`` around each as a mesh."""
    along, up = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 25), np.linspace(0.0, np.pi, 13))
    sphere = np.stack([np.cos(along) * np.sin(up), np.sin(along) * np.sin(up), np.cos(up)])
    for *centre, radius in balls:
        inner, outer = (np.reshape(centre, (3, 1, 1)) + r * sphere for r in (radius, radius + clearance))
        axes.plot_surface(*inner, color="0.45", rstride=1, cstride=1, alpha=0.7)
        axes.plot_wireframe(*outer, color="0.7", rstride=3, cstride=3, linewidth=0.5, linestyle=":")


def broken(track: Tensor, jump: float) -> Tensor:
    """A track ``(K, c)`` with a gap (NaN) where it goes around the torus, that is where it leaps by more than ``jump``."""
    leap = (track[1:] - track[:-1]).abs().amax(dim=-1) > jump
    track = track.clone()
    track[1:][leap] = math.nan
    return track


def tracks(path: Path, k: int) -> list[tuple[Tensor, dict[str, Any]]]:
    """The states ``(k + 1, d)`` of each path up to frame ``k``, with the style of its line; with noise then those of the
    mean of each start."""
    several = path.samples > 1
    looks = dict(linewidth=0.6, alpha=0.5) if several else dict(linewidth=1.2)
    drawn = [(x[: k + 1], {"color": f"C{i // path.samples}", **looks}) for i, x in enumerate(path.states.unbind(1))]
    means = path.means.unbind(1) if several else ()
    return drawn + [(x[: k + 1], {"color": f"C{i}", "linewidth": 2.5}) for i, x in enumerate(means)]
