"""Links, quadrotors and satellites: against Lagrange's and Newton's equations, conserved quantities, and linear theory."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from ocp_torch.maths.runge_kutta import discounted_integral
from ocp_torch.problems import Acrobot, Pendubot, Quadrotor, Satellite
from ocp_torch.problems.systems.rest import linearised, optimal_contraction, riccati
from ocp_torch.runs.metrics.trial import random_starts
from support import zoo

ROUNDING = dict(rtol=1e-9, atol=1e-9)


def inside(problem, count, seed=0):
    """Physical states of the box, and controls within half of the limits, or of size 1."""
    generator = torch.Generator().manual_seed(seed)
    draws = torch.rand(count, problem.dim, generator=generator, dtype=torch.float64) - 0.5
    s = problem.chart.centre + 0.75 * problem.chart.length * draws
    return s, torch.randn(count, problem.control_dim, generator=generator, dtype=torch.float64)


def derivative(problem, s, u):
    """`ds / dt` ``(N, d)`` in physical units."""
    a, B = problem.dynamics(s)
    return a + torch.einsum("ndm,nm->nd", B, u)


def along(function, s, way):
    """The derivative ``(N,)`` of ``function`` of a state along ``way``."""
    return torch.func.jvp(function, (s,), (way,))[1]


# Double pendulum.
def lagrangian(problem, q, w):
    """Of one state: a point mass at each link's centre and the inertia about it, by the velocities of the centres."""
    (m1, m2), (l1, _), (r1, r2) = problem.masses, problem.lengths, problem.centres
    spins = [i - m * r**2 for i, m, r in zip(problem.inertias, problem.masses, problem.centres, strict=True)]
    place = lambda q: torch.stack(
        [
            -r1 * q[0].sin(),
            r1 * q[0].cos(),
            -l1 * q[0].sin() - r2 * q.sum().sin(),
            l1 * q[0].cos() + r2 * q.sum().cos(),
        ]
    )
    at, velocity = torch.func.jvp(place, (q,), (w,))
    kinetic = 0.5 * (m1 * velocity[:2].square().sum() + m2 * velocity[2:].square().sum())
    kinetic = kinetic + 0.5 * (spins[0] * w[0] ** 2 + spins[1] * w.sum() ** 2)
    return kinetic - problem.gravity * (m1 * at[1] + m2 * at[3])


@pytest.mark.nightly
@pytest.mark.parametrize("cls", [Acrobot, pytest.param(Pendubot, marks=pytest.mark.nightly)])
def test_the_links_move_as_lagranges_equations_say(cls):
    problem = cls(damping=[0.02, 0.05])
    states, torques = inside(problem, 40)
    found = derivative(problem, states, torques)
    damping, joint = torch.tensor(problem.damping, dtype=torch.float64), 1 if cls is Acrobot else 0
    for s, tau, rate in zip(states, torques, found, strict=True):
        q, w = s[:2], s[2:]
        slope = torch.func.grad(lambda w, q=q: lagrangian(problem, q, w))
        M = torch.func.hessian(lambda w, q=q: lagrangian(problem, q, w))(w)
        moved = torch.func.jvp(lambda q, w=w: torch.func.grad(lambda v: lagrangian(problem, q, v))(w), (q,), (w,))[1]
        assert slope(w).shape == moved.shape
        force = torch.func.grad(lambda q, w=w: lagrangian(problem, q, w))(q) - moved - damping * w
        force = force + tau * torch.eye(2, dtype=torch.float64)[joint]
        torch.testing.assert_close(rate, torch.cat([w, torch.linalg.solve(M, force)]), **ROUNDING)


@pytest.mark.parametrize("cls", [Acrobot, Pendubot])
def test_the_energy_of_the_links_changes_by_what_the_motor_does_and_the_bearings_take(cls):
    problem = cls(damping=[0.02, 0.05])
    s, tau = inside(problem, 200)
    w = s[:, 2:]
    power = tau[:, 0] * w[:, problem.joint] - (torch.tensor(problem.damping, dtype=torch.float64) * w.square()).sum(
        dim=-1
    )
    torch.testing.assert_close(along(problem.energy, s, derivative(problem, s, tau)), power, **ROUNDING)
    still = cls(damping=[0.0, 0.0])
    start = torch.tensor([[3.0, 0.4, 1.0, -2.0], [2.0, -1.0, 0.0, 0.0]], dtype=torch.float64)
    _, end = discounted_integral(lambda x: (still.drift(x), x[:, 0]), still.to_torus(start), 1.0, 2.0, 1000)
    torch.testing.assert_close(still.energy(still.from_torus(end)), still.energy(start), rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("cls", [Acrobot, Pendubot])
def test_the_links_rest_upright_hanging_and_folded_and_fall_from_upright_alone_twice(cls):
    problem = cls(damping=[0.0, 0.0])
    unstable = []
    for first, second in ((0.0, 0.0), (0.0, math.pi), (math.pi, math.pi), (math.pi, 0.0)):
        at = torch.tensor([[first, second, 0.0, 0.0]], dtype=torch.float64)
        torch.testing.assert_close(problem.dynamics(at)[0], torch.zeros_like(at), rtol=0.0, atol=1e-12)
        A = linearised(problem, at[0].tolist())[0]
        unstable.append(int((torch.linalg.eigvals(A).real > 1e-6).sum()))
    assert unstable == [2, 1, 1, 0]
    joints = problem.joints(torch.tensor([[0.0, 0.0, 0.0, 0.0], [math.pi, 0.0, 0.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(joints[:, -1], torch.tensor([[0.0, 0.5], [0.0, -0.5]]).double(), **ROUNDING)


def test_hanging_starts_hang_and_other_starts_are_anywhere():
    hanging, anywhere = (cls.from_torus(random_starts(cls, 200, 0)) for cls in (Acrobot(starts="hanging"), Acrobot()))
    assert float(hanging[:, 0].cos().max()) < math.cos(math.pi - 0.51)
    assert float(hanging[:, 2:].abs().max()) <= 1.0
    assert float(anywhere[:, 0].cos().max()) > 0.9
    assert bool((anywhere[:, 2:].abs().amax(dim=0) <= torch.tensor([4.5, 7.5])).all())


# Quadrotor.
def test_a_quadrotor_hovers_and_is_a_rigid_body_under_two_thrusts():
    problem = Quadrotor()
    s, u = inside(problem, 200)
    level = s.clone()
    level[:, 2:] = 0.0
    torch.testing.assert_close(derivative(problem, level, torch.zeros_like(u)), torch.zeros_like(s), **ROUNDING)
    rate, thrusts = derivative(problem, s, u), 0.5 * problem.mass * problem.gravity + u
    body = torch.stack([-s[:, 2].sin(), s[:, 2].cos()], dim=-1)
    force = (
        thrusts.sum(dim=-1, keepdim=True) * body - problem.mass * problem.gravity * torch.tensor([0.0, 1.0]).double()
    )
    torch.testing.assert_close(problem.mass * rate[:, 3:5], force, **ROUNDING)
    torch.testing.assert_close(problem.inertia * rate[:, 5], problem.arm * (u[:, 1] - u[:, 0]), **ROUNDING)
    energy = lambda s: (
        0.5 * problem.mass * s[:, 3:5].square().sum(dim=-1)
        + 0.5 * problem.inertia * s[:, 5].square()
        + problem.mass * problem.gravity * s[:, 1]
    )
    # What each rotor does is its thrust times the speed of its place along it.
    places = (s[:, 3:5] * body).sum(dim=-1, keepdim=True) + problem.arm * s[:, 5:] * torch.tensor([-1.0, 1.0])
    torch.testing.assert_close(along(energy, s, rate), (thrusts * places).sum(dim=-1), **ROUNDING)


def test_a_quadrotor_in_the_mirror_flies_in_the_mirror():
    problem = Quadrotor(obstacles=[])
    s, u = inside(problem, 100)
    flip = torch.tensor([-1.0, 1.0, -1.0, -1.0, 1.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(derivative(problem, s * flip, u.flip(1)), derivative(problem, s, u) * flip, **ROUNDING)
    torch.testing.assert_close(problem.cost(s * flip), problem.cost(s), **ROUNDING)


def test_starts_of_a_quadrotor_keep_off_obstacles_and_walls():
    problem = Quadrotor()
    x = random_starts(problem, 300, 0)
    assert x.shape == (300, 6)
    assert float(problem.gap(x).min()) > problem.clearance
    assert not problem.outside(x).any()
    s = problem.from_torus(x)
    away = (s[:, :2] - torch.tensor([0.9, 1.0], dtype=torch.float64)).norm(dim=-1) - 0.25
    torch.testing.assert_close(problem.gap(x), away, **ROUNDING)


# Satellite.
def turn(sigma):
    """The rotation from body to space of modified Rodrigues parameters, by SciPy."""
    return Rotation.from_mrp(sigma.numpy())


def test_a_satellite_keeps_its_angular_momentum_in_space_and_its_energy():
    problem = Satellite()
    s, _ = inside(problem, 20, seed=1)
    s[:, :3] *= 0.5
    # Drawn out of the box it would be slowed down: in physical units nothing is.
    rate = lambda s: (problem.dynamics(s)[0], s[:, 0])
    _, end = discounted_integral(rate, s, 1.0, 8.0, 200, wrap=False)
    J = torch.tensor(problem.inertia, dtype=torch.float64)
    momentum = lambda s: torch.from_numpy(turn(s[:, :3]).apply((s[:, 3:] @ J).numpy()))
    energy = lambda s: 0.5 * torch.einsum("ni,ij,nj->n", s[:, 3:], J, s[:, 3:])
    assert float((end - s).abs().max()) > 0.1
    torch.testing.assert_close(momentum(end), momentum(s), rtol=1e-7, atol=1e-5)
    torch.testing.assert_close(energy(end), energy(s), rtol=1e-8, atol=0.0)
    torques = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    change = along(energy, s, derivative(problem, s, torques))
    torch.testing.assert_close(change, (torques * s[:, 3:]).sum(dim=-1), **ROUNDING)


def test_the_pointing_error_is_the_angle_of_the_rotation_and_a_steady_turn_is_one():
    problem = Satellite(inertia=[[5.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 5.0]])
    s, _ = inside(problem, 50)
    angles = torch.from_numpy(turn(s[:, :3]).magnitude())
    torch.testing.assert_close(problem.angle(s), angles, **ROUNDING)
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    start = torch.cat([torch.zeros(3).double(), 0.1 * axis])[None]
    _, end = discounted_integral(lambda s: (problem.dynamics(s)[0], s[:, 0]), start, 1.0, 30.0, 500, wrap=False)
    torch.testing.assert_close(end[:, :3], math.tan(3.0 / 4.0) * axis[None], rtol=1e-8, atol=1e-10)
    cost = 4.0 * (1.0 - math.cos(3.0 / 2.0)) + problem.rate_cost * 0.01
    assert float(problem.cost(end)) == pytest.approx(cost, rel=1e-8)


# All of them.
RESTS = {
    "acrobot": [0.0] * 4,
    "pendubot": [0.0] * 4,
    "quadrotor": [0.0, 1.5, 0.0, 0.0, 0.0, 0.0],
    "satellite": [0.0] * 6,
}


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.nightly) if n in ("acrobot", "pendubot") else n for n in RESTS]
)
def test_near_rest_the_regulator_costs_what_the_riccati_equation_says(name):
    """So the linear system, the cost's Hessian and the scale of the controls are those of the problem on the torus."""
    problem, rest = zoo.build(name), torch.tensor(RESTS[name], dtype=torch.float64)
    A, B, Q = linearised(problem, rest.tolist())
    P = riccati(A, B, Q, problem.discount)
    assert optimal_contraction(A, B, Q, problem.discount) == pytest.approx(-float((A - B @ B.T @ P).trace()), rel=1e-6)
    draws = torch.randn(6, problem.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    off = 1e-4 * draws / draws.abs().max() * problem.chart.length
    policy = lambda x: -(problem.from_torus(x) - rest) @ (B.T @ P).T
    rate = lambda x: problem.state_cost(x) + problem.control_cost.cost(policy(x))
    closed = lambda x: (problem.velocity(x, policy(x)), rate(x))
    x0, horizon = problem.to_torus(rest + off), 12.0 / problem.discount
    total, _ = discounted_integral(closed, x0, problem.discount, horizon, 400, grading=2.0)
    expected = 0.5 * problem.discount * torch.einsum("ni,ij,nj->n", off, P, off)
    torch.testing.assert_close(total, expected, rtol=5e-3, atol=0.0)


@pytest.mark.parametrize("name", RESTS)
def test_noise_enters_as_the_controls_do(name):
    noise = "thrust_noise" if name == "quadrotor" else "torque_noise"
    problem = type(zoo.build(name))(**{noise: 0.3})
    x = zoo.states(problem, 50)
    pushed = 0.3 * problem.from_controls(problem.control_matrix(x)) * problem._roots.square()
    torch.testing.assert_close(problem.noise(x), pushed, **ROUNDING)
