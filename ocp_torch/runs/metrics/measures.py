"""Trajectories at equal times, for metrics and pictures but not for certificates, and the metrics of each system."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import singledispatch

import torch
from torch import Tensor

from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.policies import Policy
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.problems.physical.system import System
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.cart_pole import CartPole
from ocp_torch.problems.systems.double_pendulum import DoublePendulum
from ocp_torch.problems.systems.dubins import Dubins
from ocp_torch.problems.systems.inverted_double_pendulum import InvertedDoublePendulum
from ocp_torch.problems.systems.kuramoto import Kuramoto
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.mountain_car import MountainCar
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.phase_locked_loop import PhaseLockedLoop
from ocp_torch.problems.systems.phase_neurons import PhaseNeurons
from ocp_torch.problems.systems.planar import PlanarVehicle
from ocp_torch.problems.systems.quadrotor import Quadrotor
from ocp_torch.problems.systems.reaching import Reaching
from ocp_torch.problems.systems.satellite import Satellite

# Definitions of the metrics, not tuned.
REACHED = 0.05  # distance from the target, as a part of the arm's length or the plane's width
LOCKED = 0.5 * math.pi  # rad of phase error, beyond which a detector pushes the wrong way
POINTED = 1.0  # degrees of pointing error
UPRIGHT = (0.2, 0.5)  # tilt in rad and speed in rad/s
LATE = 0.25  # part of a trajectory that counts as its end


@dataclass(frozen=True)
class Path:
    """``times`` ``(K,)`` in the problem's unit, ``states`` ``(K, N, d)``, and the discounted ``cost`` ``(N,)`` of each path;
    ``samples`` consecutive paths are draws of the noise from one start."""

    times: Tensor
    states: Tensor
    cost: Tensor
    samples: int = 1

    @property
    def means(self) -> Tensor:
        """The mean path of the samples of each start, ``(K, N / samples, d)``: of the distances gone, as opposite states on
        the torus have no mean."""
        moves = (self.states.diff(dim=0) + 0.5).remainder(1.0) - 0.5
        ways = torch.cat([self.states[:1], self.states[:1] + moves.cumsum(dim=0)])
        return ways.unflatten(1, (-1, self.samples)).mean(dim=2).remainder(1.0)

    def each(self, function: Callable[[Tensor], Tensor], late: bool = False) -> Tensor:
        """``function`` ``(N, d) -> (N,)`` at all states, or only at those of the last quarter of the time, ``(K', N)``."""
        x = self.states[-max(1, round(LATE * len(self.times))) :] if late else self.states
        return function(x.flatten(0, 1)).reshape(x.shape[:2])


@torch.no_grad()
def simulate(problem: Problem, policy: Policy, x0: Tensor, duration: float, steps: int, samples: int = 1) -> Path:
    r"""The paths under ``policy`` from ``x0`` ``(N, d)`` for ``duration``, in ``steps`` steps: by RK4 with a control
    recomputed at each stage. With noise ``samples`` paths from each start, by the midpoint rule plus the noise of a step,
    whose draws are the same for all controllers with the same steps. A `HeldPolicy` is asked at least as often as it is made
    for, and held in between, in finer steps.

    The cost is `int_0^T rho e^{-rho t} (f + R(u)) dt` by the trapezoidal rule: good to a few digits, without the error bound
    of the certificate's performance.
    """
    holds, substeps = 1, 1  # of each step
    if isinstance(policy, HeldPolicy):
        holds, substeps = math.ceil(duration / steps / policy.pace.step), policy.pace.substeps
    finer = holds * substeps
    h, rho = duration / (steps * finer), problem.discount
    control = policy
    velocity = lambda x: problem.velocity(x, control(x))
    times = h * torch.arange(steps * finer + 1, dtype=x0.dtype)
    weight = rho * h * (-rho * times).exp()
    weight[0], weight[-1] = 0.5 * weight[0], 0.5 * weight[-1]
    samples, generator = samples if problem.noisy else 1, fixed_generator()
    x0 = x0.repeat_interleave(samples, dim=0)
    x, states = x0, [x0.remainder(1.0)]
    cost = torch.zeros_like(x0[:, 0])
    for k in range(steps * finer):
        if isinstance(policy, HeldPolicy) and k % substeps == 0:
            held = policy(x)
            control = lambda at, u=held: u  # type: ignore[misc]
        v1, rate = problem.motion(x, control(x))
        cost = cost + weight[k] * rate
        v2 = velocity(x + 0.5 * h * v1)
        sigma = problem.noise(x)
        if sigma is None:
            v3 = velocity(x + 0.5 * h * v2)
            x = x + h / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + velocity(x + h * v3))
        else:
            drawn = torch.randn(len(x), sigma.shape[-1], dtype=x.dtype, generator=generator)
            x = x + h * v2 + h**0.5 * torch.einsum("ndk,nk->nd", sigma, drawn)
        x = x.remainder(1.0)
        if (k + 1) % finer == 0:
            states.append(x)
    _, rate = problem.motion(x, policy(x))
    return Path(times[::finer], torch.stack(states), cost + weight[-1] * rate, samples)


def admissible(problem: Problem, x: Tensor) -> Tensor:
    """Whether states ``x`` are fair starts, ``(N,)``: those that keep the clearance from obstacles; all without obstacles."""
    if isinstance(problem, Reaching):
        return problem.gap(x) > problem.clearance
    return torch.ones_like(x[:, 0], dtype=torch.bool)


@singledispatch
def measure(problem: Problem, path: Path) -> dict[str, float] | None:
    """The metrics of ``path`` by name; `None` for a problem without any."""
    return None


@measure.register(Linkage)
@measure.register(PlanarVehicle)
def _(problem, path: Path) -> dict[str, float]:
    """Success: at the end within 5 % of the arm's length or the plane's size of the target, never in an obstacle, and never
    out of a room."""
    size = problem.length if isinstance(problem, Linkage) else problem.size
    reached = problem.distance(path.states[-1]) <= REACHED * size
    crossed, left = (path.each(problem.gap) < 0.0).any(dim=0), path.each(problem.outside).any(dim=0)
    found = {"success": _part(reached & ~crossed & ~left), "reached": _part(reached), "crossed": _part(crossed)}
    return found | ({"left": _part(left)} if problem.chart.boxed else {})


@measure.register
def _(problem: Dubins, path: Path) -> dict[str, float]:
    """The mean late distance from the target in metres, as the vehicle cannot stop; and the parts of the starts from which it
    is ever in an obstacle or out of a room."""
    crossed, left = (path.each(problem.gap) < 0.0).any(dim=0), path.each(problem.outside).any(dim=0)
    found = {"distance": float(path.each(problem.distance, late=True).mean()), "crossed": _part(crossed)}
    return found | ({"left": _part(left)} if problem.walls else {})


@measure.register(Kuramoto)
@measure.register(PhaseNeurons)
def _(problem, path: Path) -> dict[str, float]:
    """The mean order parameter at the start, and over the last quarter of the time."""
    before, after = problem.order_parameter(path.states[0]), path.each(problem.order_parameter, late=True)
    return {"order_before": float(before.mean()), "order_after": float(after.mean())}


@measure.register
def _(problem: Pendulum, path: Path) -> dict[str, float]:
    """The part of the starts from which the pendulum is upright, within 0.2 rad and 0.5 rad/s, at the end."""
    angle, velocity = problem.from_torus(path.states[-1]).unbind(dim=-1)
    return {"upright": _part((angle.abs() <= UPRIGHT[0]) & (velocity.abs() <= UPRIGHT[1]))}


@measure.register
def _(problem: DoublePendulum, path: Path) -> dict[str, float]:
    """Success: both links within 0.2 rad of upright, joints within 0.5 rad/s at the end, and never out of the box."""
    s = problem.from_torus(path.states[-1])
    return _swung_up(problem, path, torch.stack([s[:, 0], s[:, 0] + s[:, 1]], dim=-1), s[:, 2:])


@measure.register
def _(problem: Quadrotor, path: Path) -> dict[str, float]:
    """Success: at the end within 5 % of the room's width of the target; and no crash, into an obstacle or out of the box."""
    reached = problem.distance(path.states[-1]) <= REACHED * 2.0 * problem.width
    crossed, left = (path.each(problem.gap) < 0.0).any(dim=0), path.each(problem.outside).any(dim=0)
    safe = ~(crossed | left)
    return {"success": _part(reached & safe), "safe": _part(safe), "crossed": _part(crossed), "left": _part(left)}


@measure.register
def _(problem: Satellite, path: Path) -> dict[str, float]:
    """The mean pointing error in degrees, at first and late; the parts within a degree late, and ever out of the box."""
    error = lambda x: torch.rad2deg(problem.angle(problem.from_torus(x)))
    late, left = path.each(error, late=True), path.each(problem.outside).any(dim=0)
    before, pointed = float(error(path.states[0]).mean()), (late <= POINTED).all(dim=0)
    return {"error_before": before, "error": float(late.mean()), "pointed": _part(pointed), "left": _part(left)}


@measure.register
def _(problem: System, path: Path) -> dict[str, float]:
    """The part of the starts from which the box is never left."""
    left = path.each(problem.outside).any(dim=0)
    return {"inside": _part(~left)}


@measure.register
def _(problem: CartPole, path: Path) -> dict[str, float]:
    """Success: the pole within 0.2 rad and 0.5 rad/s of upright at the end, and never off the track or out of the box."""
    s = problem.from_torus(path.states[-1])
    return _swung_up(problem, path, s[:, 1:2], s[:, 3:])


@measure.register
def _(problem: InvertedDoublePendulum, path: Path) -> dict[str, float]:
    """Success: both poles within 0.2 rad and 0.5 rad/s of upright at the end, and never out of the box; and the part of the
    starts from which the cart ever leaves the track."""
    s = problem.from_torus(path.states[-1])
    off = path.each(lambda x: problem.from_torus(x)[:, 0].abs() > problem.track).any(dim=0)
    return _swung_up(problem, path, s[:, 1:3], s[:, 4:]) | {"off_track": _part(off)}


@measure.register
def _(problem: MountainCar, path: Path) -> dict[str, float]:
    """The parts of the starts from which the goal is reached, and from which the box is ever left elsewhere."""
    arrived, left = path.each(problem.arrived).any(dim=0), path.each(problem.outside).any(dim=0)
    return {"arrived": _part(arrived), "left": _part(left)}


@measure.register
def _(problem: PhaseLockedLoop, path: Path) -> dict[str, float]:
    """Locked: over the last quarter of the time never beyond a quarter turn; and the root mean square error then, in rad."""
    phase = path.each(lambda x: problem.from_torus(x)[:, 0], late=True)
    locked = (phase.abs() <= LOCKED).all(dim=0)
    return {"locked": _part(locked), "phase_error": float(phase.square().mean().sqrt())}


def has_metrics(problem: Problem) -> bool:
    """Whether ``problem`` has metrics."""
    return measure.dispatch(type(problem)) is not measure.dispatch(Problem)


def _swung_up(problem: System, path: Path, tilts: Tensor, speeds: Tensor) -> dict[str, float]:
    """Metrics of bodies that must stay in the box and be upright at the end, at ``tilts`` and ``speeds`` ``(N, k)``."""
    upright = (tilts.cos() >= math.cos(UPRIGHT[0])).all(dim=-1) & (speeds.abs() <= UPRIGHT[1]).all(dim=-1)
    left = path.each(problem.outside).any(dim=0)
    return {"success": _part(upright & ~left), "upright": _part(upright), "left": _part(left)}


def _part(flags: Tensor) -> float:
    return float(flags.double().mean())
