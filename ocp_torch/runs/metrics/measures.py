"""What is measured on each system, and which states are fair to start from."""

from __future__ import annotations

from functools import singledispatch

import torch
from torch import Tensor

from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.dubins import Dubins
from ocp_torch.problems.systems.kuramoto import Kuramoto
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.phase_neurons import PhaseNeurons
from ocp_torch.problems.systems.planar import PlanarVehicle
from ocp_torch.runs.metrics.trajectories import Path

# What counts as reached, relative to the arm's length or the period of the plane; as upright, in rad and rad/s. Definitions
# of what the numbers say, not tuned.
REACHED = 0.05
UPRIGHT = (0.2, 0.5)


@singledispatch
def measure(problem: Problem, path: Path) -> dict[str, float] | None:
    """What ``path`` achieved, by name; `None` for a problem that asks for nothing but a low cost."""
    return None


@singledispatch
def admissible(problem: Problem, x: Tensor) -> Tensor:
    """Which states ``(N,)`` are fair starts; all, unless there are obstacles: then those that keep the clearance."""
    return torch.ones_like(x[:, 0], dtype=torch.bool)


@admissible.register(Linkage)
@admissible.register(PlanarVehicle)
def _(problem, x: Tensor) -> Tensor:
    return problem.gap(x) > problem.clearance


def _reaching(problem, path: Path, tolerance: float) -> dict[str, float]:
    reached = problem.distance(path.states[-1]) <= tolerance
    crossed = (path.each(problem.gap) < 0.0).any(dim=0)
    return {"success": _part(reached & ~crossed), "reached": _part(reached), "crossed": _part(crossed)}


@measure.register
def _(problem: Linkage, path: Path) -> dict[str, float]:
    """Success: the tip within 5 % of the arm's length of the target at the end, and no link ever in an obstacle."""
    return _reaching(problem, path, REACHED * problem.length)


@measure.register
def _(problem: PlanarVehicle, path: Path) -> dict[str, float]:
    """Success: within 5 % of the plane's period of the target at the end, and never in an obstacle."""
    return _reaching(problem, path, REACHED * problem.size)


@measure.register
def _(problem: Dubins, path: Path) -> dict[str, float]:
    """It cannot stop: the mean distance from the target late on, in metres; and how many were ever in an obstacle."""
    away = path.each(problem.distance, path.late())
    crossed = (path.each(problem.gap) < 0.0).any(dim=0)
    return {"distance": float(away.mean()), "crossed": _part(crossed)}


@measure.register(Kuramoto)
@measure.register(PhaseNeurons)
def _(problem, path: Path) -> dict[str, float]:
    """The order parameter at the start and, over the last quarter of the time, late."""
    late = path.each(problem.order_parameter, path.late())
    return {"order_before": float(problem.order_parameter(path.states[0]).mean()), "order_after": float(late.mean())}


@measure.register
def _(problem: Pendulum, path: Path) -> dict[str, float]:
    """Upright: within 0.2 rad and 0.5 rad/s at the end."""
    angle, velocity = problem.from_torus(path.states[-1]).unbind(dim=-1)
    return {"upright": _part((angle.abs() <= UPRIGHT[0]) & (velocity.abs() <= UPRIGHT[1]))}


def has_metrics(problem: Problem) -> bool:
    """Whether ``problem`` has numbers of its own."""
    return measure.dispatch(type(problem)) is not measure.dispatch(Problem)


def _part(flags: Tensor) -> float:
    return float(flags.double().mean())
