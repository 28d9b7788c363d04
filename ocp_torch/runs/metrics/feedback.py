"""Classical feedback for mechanical systems: linear-quadratic, energy shaping, proportional and derivative."""

import math

import torch
from torch import Tensor

from ocp_torch.problems.physical.system import System
from ocp_torch.problems.systems.cart_pole import CartPole
from ocp_torch.problems.systems.double_integrator import DoubleIntegrator
from ocp_torch.problems.systems.double_pendulum import DoublePendulum
from ocp_torch.problems.systems.inverted_double_pendulum import InvertedDoublePendulum
from ocp_torch.problems.systems.phase_locked_loop import PhaseLockedLoop
from ocp_torch.problems.systems.quadrotor import Quadrotor
from ocp_torch.problems.systems.rest import linearised, riccati
from ocp_torch.problems.systems.satellite import Satellite

# Double pendulum driven at the shoulder, and at the elbow: gains on the driven joint's angle (1/s^2) and velocity (1/s) and
# of the energy term (1/(J s)), and the cost of the linear balance below which it balances.
SWINGS = (13.0, 2.0, 4.0, 1.5), (14.0, 9.0, 31.0, 2.5)
# Double pendulum: limit of the missing energy times the other joint's velocity.
PUMPED = 5.0
STIFFNESS = 0.1  # satellite: frequency of the critically damped loop, in rad/s
SHAPING = 15.0  # cart and pole: gain of the energy, per J m
CENTRE = (2.0, 2.0)  # cart and pole: gains on the position (1/s^2) and velocity (1/s) of the cart
BALANCED = 0.4  # cart and pole: cost of the linear balance below which it balances
NATURAL = 1.0  # phase-locked loop: natural frequency in rad/s
DAMPED = 0.707  # phase-locked loop: damping ratio


def regulator(system: System, rest: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """`P` and `B'P` at a state of ``rest`` (`riccati`, undiscounted), for physical states; computed once for a system."""
    kept = vars(system)
    if "_regulator" not in kept:
        with torch.enable_grad():
            A, B, Q = linearised(system, rest)
        P = riccati(A, B, Q)
        kept["_regulator"] = P, B.T @ P
    return kept["_regulator"]


def swing_up(problem: DoublePendulum, x: Tensor) -> Tensor:
    r"""Accelerate the driven joint by `-k_P theta - k_D theta' + k_E sat((E - E*) omega)`, `omega` the other joint's velocity
    (partial feedback linearisation: Spong, 1995; with the energy: Spong, 1996); near upright, LQR."""
    s, j = problem.from_torus(x), problem.joint
    a, B = problem.dynamics(s)
    stiff, damp, pump, balanced = SWINGS[j]
    upright = s.new_zeros(1, problem.dim)
    missing = problem.energy(s) - problem.energy(upright)
    bend, tip = (wrapped(angle) for angle in (s[:, j], s[:, 0] + s[:, 1]))
    wanted = -stiff * bend - damp * s[:, 2 + j] + pump * (missing * s[:, 3 - j]).clamp(-PUMPED, PUMPED)
    swing = problem.to_controls(((wanted - a[:, 2 + j]) / B[:, 2 + j, 0]).unsqueeze(-1))
    off = torch.stack([s[:, 0], tip - s[:, 0], s[:, 2], s[:, 3]], dim=-1)
    P, K = (matrix.to(x) for matrix in regulator(problem, (0.0,) * 4))
    near = 0.5 * torch.einsum("ni,ij,nj->n", off, P, off) < balanced
    return torch.where(near.unsqueeze(-1), -off @ K.T, swing)


def shape_energy(problem: CartPole, x: Tensor) -> Tensor:
    r"""Accelerate the cart by `k E theta' cos theta - k_1 p - k_2 p'`, `E` the energy of the pole on a standing cart, so that
    `E` goes to 0; near upright, LQR (Chung and Hauser, 1995; Spong, 1996)."""
    s = problem.from_torus(x)
    position, pole, velocity, spin = s.unbind(dim=-1)
    a, B = problem.dynamics(s)
    energy = problem.energy(torch.stack([position, pole, torch.zeros_like(pole), spin], dim=-1))
    wanted = SHAPING * energy * spin * pole.cos() - CENTRE[0] * position - CENTRE[1] * velocity
    swing = problem.to_controls(((wanted - a[:, 2]) / B[:, 2, 0]).unsqueeze(-1))
    P, K = (matrix.to(x) for matrix in regulator(problem, (0.0,) * 4))
    near = 0.5 * torch.einsum("ni,ij,nj->n", s, P, s) < BALANCED
    return torch.where(near.unsqueeze(-1), -s @ K.T, swing)


def balance(problem: InvertedDoublePendulum, x: Tensor) -> Tensor:
    """LQR about upright in the middle of the track."""
    _, K = regulator(problem, (0.0,) * 6)
    return -problem.from_torus(x) @ K.T.to(x)


def linear_quadratic(problem: DoubleIntegrator, x: Tensor) -> Tensor:
    """The linear controller of the plane: optimal, unless it leaves the box."""
    return problem.plane.control(problem.from_torus(x))


def loop_filter(problem: PhaseLockedLoop, x: Tensor) -> Tensor:
    """The loop of second order with a sinusoidal detector: `2 zeta w_n sin phi` and `w_n^2 sin phi` (Gardner, chapter 2)."""
    detected = problem.from_torus(x)[:, 0].sin()
    return problem.to_controls(torch.stack([2.0 * DAMPED * NATURAL * detected, NATURAL**2 * detected], dim=-1))


def hover(problem: Quadrotor, x: Tensor) -> Tensor:
    """LQR about hovering at the target, which ignores obstacles."""
    rest = (*problem.target, 0.0, 0.0, 0.0, 0.0)
    _, K = regulator(problem, rest)
    return -(problem.from_torus(x) - x.new_tensor(rest)) @ K.T.to(x)


def point(problem: Satellite, x: Tensor) -> Tensor:
    r"""`u = -4 J k^2 sigma - 2 J k omega`, `J` the mean moment of inertia: stable from everywhere (Tsiotras, 1996)."""
    s = problem.from_torus(x)
    mean = sum(problem.inertia[i][i] for i in range(3)) / 3.0
    return problem.to_controls(-mean * (4.0 * STIFFNESS**2 * s[:, :3] + 2.0 * STIFFNESS * s[:, 3:]))


def wrapped(angle: Tensor) -> Tensor:
    """Angles in [-pi, pi)."""
    return (angle + math.pi).remainder(2.0 * math.pi) - math.pi
