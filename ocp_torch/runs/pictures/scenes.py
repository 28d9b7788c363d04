"""Drawings of systems, and which system has which: arms, vehicles in their plane, phases, phase portraits."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from ocp_torch.problems.physical.coordinates import Interval
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.cart_pole import CartPole
from ocp_torch.problems.systems.double_pendulum import DoublePendulum
from ocp_torch.problems.systems.inverted_double_pendulum import InvertedDoublePendulum
from ocp_torch.problems.systems.kuramoto import Kuramoto
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.phase_neurons import PhaseNeurons
from ocp_torch.problems.systems.planar import PlanarVehicle
from ocp_torch.problems.systems.quadrotor import Quadrotor
from ocp_torch.problems.systems.robot import RobotArm
from ocp_torch.problems.systems.satellite import Satellite
from ocp_torch.runs.frame import frame_of
from ocp_torch.runs.metrics.measures import Path
from ocp_torch.runs.pictures.bodies import GHOSTS, draw_cart, draw_double_pendulum, draw_quadrotors, draw_satellites
from ocp_torch.runs.pictures.strokes import broken, draw_balls, draw_obstacles, tracks


def draw_arm(problem: Linkage, axes: Any, path: Path, k: int) -> None:
    """One trajectory: poses from light to dark, the path of the tip, target and obstacles; in the plane or in space. With
    noise poses of the mean, and each tip's path."""
    base = [0.0] * len(problem.shoulder)
    reach = 1.08 * max(problem.length, *(math.dist(problem.shoulder, place) for place in (problem.target, base)))
    limits = {f"{name}lim": (at - reach, at + reach) for name, at in zip("xyz", problem.shoulder, strict=False)}
    obstacles = draw_obstacles if len(base) == 2 else draw_balls
    obstacles(axes, problem.obstacles, problem.clearance)
    *others, (mean, _) = tracks(path, k)
    joints = lambda x: problem.joints(problem.from_torus(x))
    poses = joints(mean)
    for x, look in others:
        axes.plot(*joints(x)[:, -1].T, "-", **{**look, "color": "C1"})
    for j in range(0, k + 1, max(1, len(path.times) // GHOSTS)):
        axes.plot(*poses[j].T, "-", color="C0", alpha=0.15 + 0.35 * j / len(path.times))
    axes.plot(*poses[:, -1].T, "-", color="C1", linewidth=1.0)
    axes.plot(*poses[k].T, "o-", color="C0", linewidth=3.0, markersize=5)
    axes.plot(*problem.target, "*", color="C3", markersize=14)
    axes.set(**limits, aspect="equal", xlabel="m", title=f"{path.times[k]:.2f} s")


def draw_vehicles(problem: PlanarVehicle, axes: Any, path: Path, k: int) -> None:
    """Tracks in the plane or the room, with headings at some times."""
    draw_obstacles(axes, problem.obstacles, problem.clearance, None if problem.walls else problem.size)
    some = torch.cat([torch.arange(0, k, max(1, len(path.times) // 16)), torch.tensor([k])])
    for x, look in tracks(path, k):
        track, ahead = (s := problem.from_torus(x))[:, :2], problem.heading(s)
        axes.plot(*broken(track, 0.5 * problem.size).T, **look)
        if "alpha" not in look:
            axes.quiver(*track[some].T, *ahead[some].T, color=look["color"], scale=28, width=0.005, pivot="mid")
    axes.plot(*problem.target, "*", color="k", markersize=14)
    limits = {"xlim": (0, problem.size), "ylim": (0, problem.size)}
    axes.set(**limits, aspect="equal", title=f"{path.times[k]:.2f} s")
    axes.set(xlabel=problem.coordinates[0].label, ylabel=problem.coordinates[1].label)


def draw_phases(problem: Kuramoto | PhaseNeurons, axes: Any, path: Path, k: int) -> None:
    """The order parameter over time, of each start and their mean."""
    order = path.each(problem.order_parameter)[: k + 1]
    axes.plot(path.times[: k + 1], order, color="C0", linewidth=0.6, alpha=0.5)
    axes.plot(path.times[: k + 1], order.mean(dim=1), color="C0", linewidth=2.5, label="mean of the starts")
    axes.set(xlim=(0, float(path.times[-1])), ylim=(0, 1.02), xlabel="time", ylabel="order parameter")


def draw_system(problem: System, axes: Any, path: Path, k: int) -> None:
    """The first two coordinates in their units, or the only one over time, with the ends of the box dotted."""
    shown = problem.coordinates[:2]
    alone = len(shown) == 1
    lines = [axes.axhline] if alone else [axes.axvline, axes.axhline]
    for line, c in zip(lines, shown, strict=True):
        for end in (c.low, c.high) if isinstance(c, Interval) else ():
            line(end, color="0.7", linestyle=":")
    halves = torch.tensor([0.5 * c.length for c in shown], dtype=torch.float64)
    for x, look in tracks(path, k):
        track = problem.from_torus(x)[:, :2]
        track = broken(track / halves, 1.0) * halves  # no line across the picture where a coordinate goes around
        drawn = torch.stack([path.times[: k + 1], track[:, 0]], dim=-1) if alone else track
        axes.plot(*drawn.T, **look)
        axes.plot(*drawn[-1], "o", color=look["color"], markersize=4)
    ends = [tuple(end) for end in frame_of(problem).ends[:2].tolist()]
    time = (0.0, float(path.times[-1]))
    axes.set(xlim=time if alone else ends[0], ylim=ends[-1], title=f"{path.times[k]:.2f}")
    axes.set_xlabel("time" if alone else shown[0].label, parse_math=False)
    axes.set_ylabel(shown[-1].label, parse_math=False)


def draw_pendulums(problem: Pendulum, axes: Any, path: Path, k: int) -> None:
    """The phase portrait of angle and velocity, and in a corner the rod of the first start at frame ``k``."""
    from matplotlib.patches import Wedge

    draw_system(problem, axes, path, k)
    corner = axes.inset_axes((0.78, 0.76, 0.2, 0.22))
    angle = float(problem.from_torus(path.states[k])[0, 0])
    corner.add_patch(Wedge((0.0, 0.0), 0.08, 0.0, 360.0, color="k"))
    corner.plot([0.0, -math.sin(angle)], [0.0, math.cos(angle)], color="C0", linewidth=4.0)
    corner.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"{path.times[k]:.2f} s")


@dataclass(frozen=True)
class Scene:
    """``draw(problem, axes, path, k)`` shows a path up to its frame ``k`` on Matplotlib axes of this ``projection``. The
    number of ``starts`` is drawn in one panel, or ``apart``, each in a panel of its own."""

    draw: Callable[[Any, Any, Path, int], None]
    starts: int
    apart: bool = False
    projection: str = "rectilinear"


# System -> its scene, each subclass before its parent.
SCENES = {
    RobotArm: Scene(draw_arm, 3, apart=True, projection="3d"),
    Linkage: Scene(draw_arm, 3, apart=True),
    PlanarVehicle: Scene(draw_vehicles, 6),
    Pendulum: Scene(draw_pendulums, 6),
    CartPole: Scene(draw_cart, 3, apart=True),
    InvertedDoublePendulum: Scene(draw_cart, 3, apart=True),
    Kuramoto: Scene(draw_phases, 24),
    PhaseNeurons: Scene(draw_phases, 24),
    DoublePendulum: Scene(draw_double_pendulum, 3, apart=True),
    Quadrotor: Scene(draw_quadrotors, 6),
    Satellite: Scene(draw_satellites, 12),
    System: Scene(draw_system, 6),
}


def scene(problem: Problem) -> Scene | None:
    """The scene of ``problem``, or `None` if it has none."""
    return next((shown for system, shown in SCENES.items() if isinstance(problem, system)), None)
