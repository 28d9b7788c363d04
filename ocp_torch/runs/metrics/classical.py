"""A simple classical controller for each system, to compare with: tuned once, by hand or by random search."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from ocp_torch.control.policies import Policy
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.systems.cart_pole import CartPole
from ocp_torch.problems.systems.double_integrator import DoubleIntegrator
from ocp_torch.problems.systems.double_pendulum import DoublePendulum
from ocp_torch.problems.systems.dubins import Dubins
from ocp_torch.problems.systems.inverted_double_pendulum import InvertedDoublePendulum
from ocp_torch.problems.systems.kuramoto import Kuramoto
from ocp_torch.problems.systems.linkage import Linkage
from ocp_torch.problems.systems.mountain_car import HILLS, MountainCar
from ocp_torch.problems.systems.pendulum import Pendulum
from ocp_torch.problems.systems.phase_locked_loop import PhaseLockedLoop
from ocp_torch.problems.systems.phase_neurons import PhaseNeurons
from ocp_torch.problems.systems.quadrotor import Quadrotor
from ocp_torch.problems.systems.satellite import Satellite
from ocp_torch.problems.systems.unicycle import Unicycle
from ocp_torch.runs.metrics import feedback

REACH = 1.5  # arms: gain, per second
DAMPING = 0.1  # arms: damping of the pseudo-inverse, relative to the arm's length
DRIVE = 1.0  # vehicles: gain of the speed, per second
STEER = 2.0  # vehicles: gain of the turn rate, per second
DESCENT = 2.0  # oscillators: gain of the descent
PUMP = 0.2  # pendulum: gain of the energy pump
BALANCE = (20.0, 5.0)  # pendulum: gains of the balance, on angle (1/s^2) and velocity (1/s)
CATCH = (0.5, 2.0)  # pendulum: angle in rad and speed in rad/s below which it balances


def classical_policy(problem: Problem) -> Policy | None:
    """The classical controller of ``problem``, or `None` where there is none."""
    found = (control for kind, control in CONTROLS.items() if isinstance(problem, kind))
    return next((partial(control, problem) for control in found), None)


def resolved_rate(problem: Linkage, x: Tensor) -> Tensor:
    r"""`dtheta/dt = k J^+ (target - p)`, `J^+` the damped pseudo-inverse (Whitney, 1969; Nakamura and Hanafusa, 1986)."""
    damping = (DAMPING * problem.length) ** 2 or 1.0  # length 0: J = 0, and any damping will do
    J, way = problem.jacobian(problem.from_torus(x)), problem.to_target(x)
    square = J @ J.mT + damping * torch.eye(way.shape[1]).to(x)
    return problem.to_controls(REACH * (J.mT @ torch.linalg.solve(square, way.unsqueeze(-1))).squeeze(-1))


def _bearing(problem: Unicycle | Dubins, x: Tensor) -> tuple[Tensor, Tensor]:
    """The offset of the target along and across the heading, in metres, both ``(N,)``."""
    way, ahead = problem.to_target(x), problem.heading(problem.from_torus(x))
    return (way * ahead).sum(dim=-1), ahead[:, 0] * way[:, 1] - ahead[:, 1] * way[:, 0]


def go_to_goal(problem: Unicycle, x: Tensor) -> Tensor:
    """Speed in proportion to the offset ahead, turn rate to the bearing of the target from the nearer end, front or back."""
    along, across = _bearing(problem, x)
    bearing = torch.atan2(across, along.abs()) * torch.where(along < 0.0, -1.0, 1.0)
    return problem.to_controls(torch.stack([DRIVE * along, STEER * bearing], dim=-1))


def pursue(problem: Dubins, x: Tensor) -> Tensor:
    """Turn rate in proportion to the bearing of the target."""
    along, across = _bearing(problem, x)
    return problem.to_controls(STEER * torch.atan2(across, along).unsqueeze(-1))


def descend(problem: Problem, x: Tensor) -> Tensor:
    r"""`u = -k B' grad f`: proportional feedback on how the stimulus changes the synchrony (for Kuramoto, the mean field)."""
    with torch.enable_grad():
        at = x.detach().requires_grad_(True)
        (slope,) = torch.autograd.grad(problem.state_cost(at).sum(), at)
    return -DESCENT / problem.discount * torch.einsum("ndm,nd->nm", problem.control_matrix(x), slope)


def energy_pump(problem: Pendulum, x: Tensor) -> Tensor:
    """Pump energy, then balance by proportional and derivative feedback (Astrom and Furuta, 2000); `|u| <= 1`."""
    angle, velocity = problem.from_torus(x).unbind(dim=-1)
    pull = 1.5 * problem.gravity / problem.length
    missing = pull * (1.0 - angle.cos()) - 0.5 * velocity.square()
    pump = PUMP * missing * torch.where(velocity < 0.0, -1.0, 1.0)
    balance = -(BALANCE[0] * angle + BALANCE[1] * velocity) / 3.0
    near = (angle.abs() < CATCH[0]) & (velocity.abs() < CATCH[1])
    return (torch.where(near, balance, pump) / problem.max_torque).clamp(-1.0, 1.0).unsqueeze(-1)


def gather_speed(problem: MountainCar, x: Tensor) -> Tensor:
    """Full force to the right; to the left while the car moves left with less than half the energy that takes it up the left
    hill; none at the goal."""
    s = problem.from_torus(x)
    bottom, top = -problem.gravity / HILLS, problem.energy(s.new_tensor([[problem.low, 0.0]]))
    back = (s[:, 1] < 0.0) & (problem.energy(s) < 0.5 * (bottom + top))
    force = torch.where(problem.arrived(x), 0.0, torch.where(back, -1.0, 1.0)).to(x)
    return problem.to_controls(force.unsqueeze(-1))


# Class of problem -> its classical control ``(N, m)`` at states ``(N, d)``.
CONTROLS: dict[type[Problem], Callable[..., Tensor]] = {
    Linkage: resolved_rate,
    Unicycle: go_to_goal,
    Dubins: pursue,
    Kuramoto: descend,
    PhaseNeurons: descend,
    Pendulum: energy_pump,
    MountainCar: gather_speed,
    CartPole: feedback.shape_energy,
    InvertedDoublePendulum: feedback.balance,
    DoubleIntegrator: feedback.linear_quadratic,
    DoublePendulum: feedback.swing_up,
    PhaseLockedLoop: feedback.loop_filter,
    Quadrotor: feedback.hover,
    Satellite: feedback.point,
}
