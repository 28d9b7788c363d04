"""How a system looks: an arm with its obstacles, vehicles in their plane, phases and their order, a pendulum's portrait."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.kuramoto import Kuramoto
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.phase_neurons import PhaseNeurons
from ocp_torch.problems.systems.planar import PlanarVehicle
from ocp_torch.problems.systems.robot import RobotArm
from ocp_torch.runs.metrics.measures import Path

# Earlier poses of an arm that stay visible.
GHOSTS = 12


def _obstacles(axes: Any, discs: list, clearance: float, period: float | None = None) -> None:
    from matplotlib.patches import Circle

    shifts = [0.0] if period is None else [-period, 0.0, period]
    for x, y, radius in discs:
        for dx in shifts:
            for dy in shifts:
                axes.add_patch(Circle((x + dx, y + dy), radius, color="0.45"))
                axes.add_patch(Circle((x + dx, y + dy), radius + clearance, fill=False, color="0.7", linestyle=":"))


def _balls(axes: Any, balls: list, clearance: float) -> None:
    """As `_obstacles`, in space."""
    along, up = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 25), np.linspace(0.0, np.pi, 13))
    sphere = np.stack([np.cos(along) * np.sin(up), np.sin(along) * np.sin(up), np.cos(up)])
    for *centre, radius in balls:
        inner, outer = (np.reshape(centre, (3, 1, 1)) + r * sphere for r in (radius, radius + clearance))
        axes.plot_surface(*inner, color="0.45", rstride=1, cstride=1, alpha=0.7)
        axes.plot_wireframe(*outer, color="0.7", rstride=3, cstride=3, linewidth=0.5, linestyle=":")


def _broken(track: Tensor, jump: float) -> Tensor:
    """A track ``(K, c)`` with a gap (NaN) where it goes around the torus."""
    leap = (track[1:] - track[:-1]).abs().amax(dim=-1) > jump
    track = track.clone()
    track[1:][leap] = math.nan
    return track


def draw_arm(problem: Linkage, axes: Any, path: Path, k: int) -> None:
    """One trajectory: poses from light to dark, the way of the tip, target and obstacles; in the plane or in space."""
    base = [0.0] * len(problem.shoulder)
    reach = 1.08 * max(problem.length, *(math.dist(problem.shoulder, place) for place in (problem.target, base)))
    limits = {f"{name}lim": (at - reach, at + reach) for name, at in zip("xyz", problem.shoulder, strict=False)}
    obstacles = _obstacles if len(base) == 2 else _balls
    obstacles(axes, problem.obstacles, problem.clearance)
    poses = problem.joints(path.states[: k + 1, 0])
    for j in range(0, k + 1, max(1, len(path.times) // GHOSTS)):
        axes.plot(*poses[j].T, "-", color="C0", alpha=0.15 + 0.35 * j / len(path.times))
    axes.plot(*poses[:, -1].T, "-", color="C1", linewidth=1.0)
    axes.plot(*poses[k].T, "o-", color="C0", linewidth=3.0, markersize=5)
    axes.plot(*problem.target, "*", color="C3", markersize=14)
    axes.set(**limits, aspect="equal", xlabel="m", title=f"{path.times[k]:.2f} s")


def draw_vehicles(problem: PlanarVehicle, axes: Any, path: Path, k: int) -> None:
    """Trajectories in the periodic plane with their headings."""
    _obstacles(axes, problem.obstacles, problem.clearance, problem.size)
    for i in range(path.states.shape[1]):
        x = path.states[: k + 1, i]
        track, ahead = problem.from_torus(x)[:, :2], problem.heading(x)
        axes.plot(*_broken(track, 0.5 * problem.size).T, color=f"C{i}", linewidth=1.2)
        some = torch.cat([torch.arange(0, k, max(1, len(path.times) // 16)), torch.tensor([k])])
        axes.quiver(*track[some].T, *ahead[some].T, color=f"C{i}", scale=28, width=0.005, pivot="mid")
    axes.plot(*problem.target, "*", color="k", markersize=14)
    limits = {"xlim": (0, problem.size), "ylim": (0, problem.size)}
    axes.set(**limits, aspect="equal", xlabel="m", title=f"{path.times[k]:.2f}")


def draw_phases(problem: Kuramoto | PhaseNeurons, axes: Any, path: Path, k: int) -> None:
    """The order parameter in time: each start, and their mean."""
    order = path.each(problem.order_parameter)[: k + 1]
    axes.plot(path.times[: k + 1], order, color="C0", linewidth=0.6, alpha=0.5)
    axes.plot(path.times[: k + 1], order.mean(dim=1), color="C0", linewidth=2.5, label="mean of the starts")
    axes.set(xlim=(0, float(path.times[-1])), ylim=(0, 1.02), xlabel="time", ylabel="order parameter")


def draw_pendulums(problem: Pendulum, axes: Any, path: Path, k: int) -> None:
    """The portrait of angle and velocity, with the band in which the model is faithful; the rod at the end in a corner."""
    from matplotlib.patches import Wedge

    for speed in (-problem.max_speed, problem.max_speed):
        axes.axhline(speed, color="0.7", linestyle=":")
    for i in range(path.states.shape[1]):
        track = problem.from_torus(path.states[: k + 1, i])
        axes.plot(*_broken(track, math.pi).T, color=f"C{i}", linewidth=1.0)
        axes.plot(*track[-1], "o", color=f"C{i}", markersize=4)
    corner = axes.inset_axes((0.78, 0.76, 0.2, 0.22))
    angle = float(problem.from_torus(path.states[k])[0, 0])
    corner.add_patch(Wedge((0.0, 0.0), 0.08, 0.0, 360.0, color="k"))
    corner.plot([0.0, -math.sin(angle)], [0.0, math.cos(angle)], color="C0", linewidth=4.0)
    corner.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), aspect="equal", xticks=[], yticks=[])
    limits = {"xlim": (-math.pi, math.pi), "ylim": (-problem.seam, problem.seam)}
    axes.set(**limits, xlabel="angle from upright, rad", ylabel="rad/s", title=f"{path.times[k]:.2f} s")


@dataclass(frozen=True)
class Scene:
    """``draw(problem, axes, path, k)`` shows a path up to its frame ``k`` on Matplotlib's axes of this ``projection``; so
    many ``starts`` are drawn, in one panel or ``apart``, each in its own."""

    draw: Callable[[Any, Any, Path, int], None]
    starts: int
    apart: bool = False
    projection: str = "rectilinear"


# System -> its scene; a subclass before its parent.
SCENES = {
    RobotArm: Scene(draw_arm, 3, apart=True, projection="3d"),
    Linkage: Scene(draw_arm, 3, apart=True),
    PlanarVehicle: Scene(draw_vehicles, 6),
    Pendulum: Scene(draw_pendulums, 6),
    Kuramoto: Scene(draw_phases, 24),
    PhaseNeurons: Scene(draw_phases, 24),
}


def scene(problem: Problem) -> Scene | None:
    """The scene of ``problem``, or `None` where a map of `V` says it all."""
    return next((shown for system, shown in SCENES.items() if isinstance(problem, system)), None)
