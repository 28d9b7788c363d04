"""Numbers a practitioner would ask for, from simulated random starts: of the controller, of zero and of a classical one."""

from __future__ import annotations

from functools import singledispatch

import torch
from torch import Tensor

from ocp_torch.control.policies import zero_policy
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import drawn_starts, starts_narrowly
from ocp_torch.problems.systems.dubins import Dubins
from ocp_torch.problems.systems.kuramoto import Kuramoto
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.phase_neurons import PhaseNeurons
from ocp_torch.problems.systems.planar import PlanarVehicle
from ocp_torch.runs.practice.classical import classical_policy
from ocp_torch.runs.practice.paths import Law, Path, simulate

STARTS, STEPS = 512, 240
# The time of a trial in units of 1 / rho; what the discount still sees after it is e^-8.
TRIAL = 8.0
# What counts as reached, relative to the arm's length or the period of the plane; as upright, in rad and rad/s.
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


def metrics(problem: Problem, policy: Law, seed: int = 0, starts: int = STARTS) -> dict | None:
    """``controller``, ``zero`` and ``classical`` (where there is one), each with its numbers and mean discounted ``cost``.

    All from the same ``starts`` (`random_starts`), for ``duration`` in the problem's unit of time; `None` for a problem
    without numbers of its own. Statistics, not bounds: a part `p` has the standard error `sqrt(p (1 - p) / starts)`.
    """
    if not has_metrics(problem):
        return None
    x0 = random_starts(problem, starts, seed)
    duration = TRIAL / problem.discount
    policies = {"controller": policy, "zero": zero_policy(problem), "classical": classical_policy(problem)}
    found = {}
    for name, each in policies.items():
        if each is None:
            continue
        path = simulate(problem, _within_limit(problem, each), x0, duration, STEPS)
        found[name] = {**measure(problem, path), "cost": float(path.cost.mean())}
    return {"starts": starts, "seed": seed, "duration": duration, **found}


def _within_limit(problem: Problem, policy: Law) -> Law:
    """``policy``, shrunk to the problem's control limit where it has one: a classical policy knows none, and others round."""
    return lambda x: problem.control_cost.within(policy(x), torch.ones_like(x[:, 0]))


def random_starts(problem: Problem, count: int, seed: int) -> Tensor:
    """``count`` starts, ``(count, d)`` float64: drawn from `mu0` where that is narrow; else uniform admissible ones, or all
    where hardly any is admissible."""
    if starts_narrowly(problem):
        return drawn_starts(problem, count, seed)
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(64 * count, problem.dim, generator=generator, dtype=torch.float64)
    fair = x[admissible(problem, x)]
    return (fair if len(fair) >= count else x)[:count]


def metrics_table(found: dict) -> str:
    """What a user reads: a row for each controller."""
    rows = {name: found[name] for name in ("controller", "zero", "classical") if name in found}
    names = list(rows["controller"])
    lines = [f"{found['starts']} random starts, {found['duration']:g} units of time"]
    lines.append(" " * 12 + "".join(f"{name:>14}" for name in names))
    lines += [f"{row:<12}" + "".join(f"{rows[row][name]:>14.4g}" for name in names) for row in rows]
    return "\n".join(lines)


def _part(flags: Tensor) -> float:
    return float(flags.double().mean())
