"""Drawings of rigid bodies: carts with poles, double pendulums, quadrotors in their room, satellites."""

from typing import Any

import torch

from ocp_torch.problems.systems.cart_pole import CartPole
from ocp_torch.problems.systems.double_pendulum import DoublePendulum
from ocp_torch.problems.systems.inverted_double_pendulum import InvertedDoublePendulum
from ocp_torch.problems.systems.quadrotor import Quadrotor
from ocp_torch.problems.systems.satellite import Satellite
from ocp_torch.runs.metrics.measures import Path
from ocp_torch.runs.pictures.strokes import draw_obstacles, tracks

# Earlier poses that stay visible, spread over the whole path.
GHOSTS = 12


def draw_double_pendulum(problem: DoublePendulum, axes: Any, path: Path, k: int) -> None:
    """One trajectory: poses from light to dark, and the tip's path; with noise poses of the mean, and all tips' paths."""
    reach = 1.08 * sum(problem.lengths)
    *others, (mean, _) = tracks(path, k)
    poses = problem.joints(problem.from_torus(mean))
    for x, look in others:
        axes.plot(*problem.joints(problem.from_torus(x))[:, -1].T, "-", **{**look, "color": "C1"})
    for j in range(0, k + 1, max(1, len(path.times) // GHOSTS)):
        axes.plot(*poses[j].T, "-", color="C0", alpha=0.15 + 0.35 * j / len(path.times))
    axes.plot(*poses[:, -1].T, "-", color="C1", linewidth=1.0)
    axes.plot(*poses[k].T, "o-", color="C0", linewidth=3.0, markersize=5)
    axes.plot(0.0, sum(problem.lengths), "*", color="C3", markersize=14)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="m", title=f"{path.times[k]:.2f} s")


def draw_cart(problem: CartPole | InvertedDoublePendulum, axes: Any, path: Path, k: int) -> None:
    """One trajectory: cart and poles from light to dark, and the path of the tip; the ends of the track dotted. With noise
    poses of the mean, and each tip's path."""
    for end in (-problem.track, problem.track):
        axes.axvline(end, color="0.7", linestyle=":")
    axes.axhline(0.0, color="0.8", linewidth=0.8)
    *others, (mean, _) = tracks(path, k)
    for x, look in others:
        axes.plot(*problem.joints(problem.from_torus(x))[:, -1].T, "-", **{**look, "color": "C1"})
    poses = problem.joints(problem.from_torus(mean))
    reach = float(poses[0].diff(dim=0).norm(dim=-1).sum())
    for j in [*range(0, k + 1, max(1, len(path.times) // GHOSTS)), k]:
        dark = dict(color="C0", alpha=1.0 if j == k else 0.15 + 0.35 * j / len(path.times))
        axes.plot(*poses[j].T, "-", linewidth=3.0 if j == k else 1.5, **dark)
        axes.plot(*poses[j, 0], "s", markersize=11 if j == k else 5, **dark)
    axes.plot(*poses[:, -1].T, "-", color="C1", linewidth=1.0)
    limits = {"xlim": (-problem.track - 1.1 * reach, problem.track + 1.1 * reach), "ylim": (-1.5 * reach, 1.5 * reach)}
    axes.set(**limits, aspect="equal", xlabel="m", title=f"{path.times[k]:.2f} s")


def draw_quadrotors(problem: Quadrotor, axes: Any, path: Path, k: int) -> None:
    """Tracks in the room, whose walls are dotted, with the bar between the rotors at some times."""
    draw_obstacles(axes, problem.obstacles, problem.clearance)
    some = torch.cat([torch.arange(0, k, max(1, len(path.times) // GHOSTS)), torch.tensor([k])])
    for x, look in tracks(path, k):
        s = problem.from_torus(x)
        axes.plot(*s[:, :2].T, **look)
        if "alpha" not in look:
            bar = problem.arm * torch.stack([s[some, 2].cos(), s[some, 2].sin()], dim=-1)
            axes.plot(
                *torch.stack([s[some, :2] - bar, s[some, :2] + bar]).unbind(-1), color=look["color"], linewidth=2.0
            )
    axes.plot(*problem.target, "*", color="k", markersize=14)
    for line, wall in zip((axes.axvline, axes.axhline), problem.room, strict=True):
        line(wall.low, color="0.7", linestyle=":")
        line(wall.high, color="0.7", linestyle=":")
    ends = [(c.centre - 0.5 * c.length, c.centre + 0.5 * c.length) for c in problem.room]
    axes.set(xlim=ends[0], ylim=ends[1], aspect="equal", xlabel="m", title=f"{path.times[k]:.2f} s")


def draw_satellites(problem: Satellite, axes: Any, path: Path, k: int) -> None:
    """The pointing error over time, of each start and their mean."""
    error = path.each(lambda x: torch.rad2deg(problem.angle(problem.from_torus(x))))[: k + 1]
    axes.plot(path.times[: k + 1], error, color="C0", linewidth=0.6, alpha=0.5)
    axes.plot(path.times[: k + 1], error.mean(dim=1), color="C0", linewidth=2.5, label="mean of the starts")
    limits = {"xlim": (0, float(path.times[-1])), "ylim": (0, 180)}
    axes.set(**limits, xlabel="time, s", ylabel="pointing error, degrees", title=f"{path.times[k]:.0f} s")
