"""Noise of the systems people have, in their own units: how far a state strays in a time, and what is still known of it."""

import math

import pytest
import torch

from ocp_torch.maths.brownian import Grid, increments, path_integral
from ocp_torch.maths.jets import diffusion_divergences
from ocp_torch.problems import (
    Acrobot,
    Arm,
    CartPole,
    Dubins,
    InvertedDoublePendulum,
    Kuramoto,
    Pendubot,
    Pendulum,
    PhaseNeurons,
    Quadrotor,
    RobotArm,
    Satellite,
    Unicycle,
)
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo
from support.refusals import refused

TURN = 2.0 * math.pi
# Paths, and how far a variance or covariance of them may be off: five standard errors of a normal variable's.
PATHS = 4096
LOOSE = 5.0 * math.sqrt(2.0 / PATHS)
NOISY = {
    "arm": Arm(joint_noise=[0.1, 0.3]),
    "robot": RobotArm(joint_noise=0.1),
    "dubins": Dubins(heading_noise=0.3, position_noise=0.05),
    "unicycle": Unicycle(heading_noise=0.3),
    "unicycle in a room": Unicycle(walls=True, heading_noise=0.3, position_noise=0.05, noise=0.001),
    "kuramoto": Kuramoto(phase_noise=0.3),
    "kuramoto absolute": Kuramoto(relative=False, phase_noise=[0.0, 0.1, 0.2]),
    "neurons": PhaseNeurons(phase_noise=[0.3, 0.0]),
    "pendulum": Pendulum(torque_noise=0.4),
    "pendulum, both": Pendulum(torque_noise=0.4, noise=[0.001, 0.002]),
    "cart-pole": CartPole(force_noise=0.5),
    "inverted double pendulum": InvertedDoublePendulum(force_noise=20.0),
    "acrobot": Acrobot(torque_noise=0.1),
    "pendubot, both": Pendubot(torque_noise=0.2, noise=0.001),
    "quadrotor": Quadrotor(thrust_noise=0.05),
    "satellite": Satellite(torque_noise=1.0),
    "arm, both": Arm(joint_noise=0.2, noise=0.001),
}


@pytest.mark.parametrize("cls", [Arm, Dubins, Kuramoto, Pendulum])
def test_noise_of_a_system_stands_beside_that_of_its_coordinates(cls):
    """`D` of both is the sum."""
    own = {"Arm": "joint_noise", "Dubins": "heading_noise", "Kuramoto": "phase_noise", "Pendulum": "torque_noise"}
    both, one, other = cls(noise=0.01, **{own[cls.__name__]: 0.3}), cls(noise=0.01), cls(**{own[cls.__name__]: 0.3})
    x = zoo.states(both, 20)
    D = lambda problem: 0.5 * problem.noise(x) @ problem.noise(x).mT
    torch.testing.assert_close(D(both), D(one) + D(other))


def ends(problem, start, time, steps=32):
    """Where `PATHS` paths from the one state ``start`` are after ``time`` without control, whole turns included."""
    x = torch.tensor([start], dtype=torch.float64).repeat(PATHS, 1)
    grid = Grid(torch.full((PATHS,), time, dtype=torch.float64), steps, 1.0)
    moves = increments(grid, problem.noise(x[:1]).shape[-1], 0, 0, 0)
    dynamics = lambda y: (problem.drift(y), torch.zeros_like(y[:, 0]))
    return path_integral(dynamics, problem.noise, x, grid, moves, lambda horizon, part: horizon)[1]


def covariance(states):
    return torch.atleast_2d(torch.cov(states.T))


def same(found, expected):
    """Covariances, up to `LOOSE` of the product of the deviations."""
    expected = torch.tensor(expected, dtype=torch.float64)
    size = expected.diagonal().sqrt()
    assert float(((found - expected) / (size.unsqueeze(0) * size.unsqueeze(1)).clamp_min(1e-12)).abs().max()) < LOOSE


@pytest.mark.parametrize("vehicle", [Dubins, Unicycle])
def test_a_free_heading_strays_by_the_noise_squared_times_the_time(vehicle):
    """In rad^2; and the position, in m^2, of one that goes nowhere else."""
    problem = vehicle(heading_noise=0.3)
    same(covariance(TURN * ends(problem, [0.2, 0.3, 0.4], 2.0)[:, 2:]), [[0.3**2 * 2.0]])
    slipping = Unicycle(position_noise=0.05, size=5.0)
    position = slipping.size * ends(slipping, [0.2, 0.3, 0.4], 2.0)[:, :2]
    same(covariance(position), [[0.05**2 * 2.0, 0.0], [0.0, 0.05**2 * 2.0]])


def test_each_joint_strays_by_its_own_noise():
    same(covariance(TURN * ends(Arm(joint_noise=[0.1, 0.3]), [0.1, 0.2], 0.5)), [[0.005, 0.0], [0.0, 0.045]])


@pytest.mark.parametrize("cls", [Kuramoto, PhaseNeurons])
def test_phases_of_uncoupled_oscillators_stray_by_their_noise(cls):
    options = dict(relative=False, oscillators=2) if cls is Kuramoto else {}
    phases = TURN * ends(cls(coupling=0.0, phase_noise=[0.2, 0.4], **options), [0.1, 0.2], 3.0)
    same(covariance(phases), [[0.12, 0.0], [0.0, 0.48]])


def test_relative_phases_share_what_the_last_one_strays_by():
    phases = TURN * ends(Kuramoto(coupling=0.0, phase_noise=[0.1, 0.2, 0.3]), [0.1, 0.2], 2.0)
    same(covariance(phases), [[0.02 + 0.18, 0.18], [0.18, 0.08 + 0.18]])
    # The differences of phases that stray are what relative coordinates say of them.
    whole = Kuramoto(coupling=0.0, relative=False, phase_noise=[0.1, 0.2, 0.3]).noise(torch.zeros(1, 3).double())[0]
    parted = torch.tensor([[1.0, 0.0, -1.0], [0.0, 1.0, -1.0]], dtype=torch.float64) @ whole
    relative = Kuramoto(phase_noise=[0.1, 0.2, 0.3]).noise(torch.zeros(1, 2).double())[0]
    torch.testing.assert_close(relative @ relative.T, parted @ parted.T)


def test_a_noisy_torque_turns_the_pendulum_as_a_torque_does():
    """Without gravity `theta'` strays by `(3 / (m l^2))^2 torque_noise^2 t`, in (rad/s)^2; a constant torque moves it by its
    own `3 / (m l^2) tau t`."""
    problem = Pendulum(gravity=0.0, mass=0.8, length=1.1, torque_noise=0.2)
    speed = problem.from_torus(ends(problem, [0.0, 0.0], 0.7))[:, 1:]
    same(covariance(speed), [[(3.0 / (0.8 * 1.1**2) * 0.2) ** 2 * 0.7]])
    x = zoo.states(problem, 20)
    pushed = problem.control_matrix(x) / problem.max_torque * problem.torque_noise
    torch.testing.assert_close(problem.noise(x), pushed)


@pytest.mark.nightly
def test_a_noisy_torque_does_not_take_the_pendulum_across_the_seam():
    problem = Pendulum(torque_noise=2.0)
    speeds = problem.seam * 2.0 * ends(problem, [0.3, 0.45], 2.0, steps=2000)[:, 1]
    assert float(speeds.max()) < problem.seam


@pytest.mark.parametrize("name", NOISY)
def test_noise_is_periodic_and_its_divergences_are_those_of_autograd(name):
    problem = NOISY[name]
    x = zoo.states(problem, 60)
    sigma = problem.noise(x)
    assert problem.noise(x.float()).dtype == torch.float32
    torch.testing.assert_close(problem.noise(x - 3.0), sigma, rtol=1e-9, atol=1e-9)
    for found, expected in zip(problem.noise_divergences(x), diffusion_divergences(problem.noise, x), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    assert type(problem)(**problem.parameters).noise(x).equal(sigma)


@pytest.mark.parametrize("name", NOISY)
def test_with_noise_nothing_is_declared_of_the_occupation(name):
    """What contracts onto a point without noise need not do so with it."""
    problem = NOISY[name]
    assert problem.occupation_bound is None
    found = resolve_constants(problem)
    assert found.unbounded
    assert found.needs_no_M
    assert math.isinf(type(problem)().occupation_bound or math.inf)


def test_the_first_noise_leaves_all_else_as_it_was():
    for problem in NOISY.values():
        options = {k: v for k, v in problem.parameters.items() if not k.endswith("noise")}
        quiet, x = type(problem)(**options), zoo.states(problem, 30)
        assert quiet.noise(x) is None
        for column in ("f", "a", "B", "mu0", "div_a", "div_B"):
            assert getattr(Samples.of(quiet, x), column).equal(getattr(Samples.of(problem, x), column))


def test_the_control_bound_with_noise_is_called_an_estimate():
    said = " ".join(resolve_constants(Arm(joint_noise=0.1)).warnings)
    assert "Proposition 2 of the paper gives with a declared sup f, which noise may take the control beyond" in said
    assert "beyond" not in " ".join(resolve_constants(Arm()).warnings)


BAD = [
    (Arm, dict(joint_noise=[0.1]), "problem.joint_noise is .* a list of 2 numbers"),
    (Arm, dict(joint_noise=-0.1), "problem.joint_noise is -0.1, but must be 0 or more"),
    (RobotArm, dict(joint_noise="much"), "problem.joint_noise"),
    (Dubins, dict(heading_noise=-1.0), "problem.heading_noise"),
    (Unicycle, dict(position_noise=math.nan), "problem.position_noise"),
    (Kuramoto, dict(phase_noise=[0.1, 0.1]), "problem.phase_noise is .* a list of 3 numbers"),
    (PhaseNeurons, dict(phase_noise=[0.1, None]), r"problem.phase_noise\[1\]"),
    (Pendulum, dict(torque_noise=[0.1]), "problem.torque_noise"),
    (Pendulum, dict(noise=[0.1]), "problem.noise is .* a list of 2 numbers"),
]


@pytest.mark.parametrize(("cls", "arguments", "message"), BAD)
def test_wrong_noise_is_refused_in_one_sentence(cls, arguments, message):
    with refused(message):
        cls(**arguments)


@pytest.mark.parametrize("name", ["pendulum", "pendulum, both", "kuramoto", "neurons", "arm, both"])
def test_generator_and_residual_are_adjoint_on_systems(name):
    """`E[-V mu + (L^0 V mu + grad V . B w) / rho] = E[V (r - mu0)]` for random fields, with a cut-off too."""
    problem, side = NOISY[name], 192
    axis = torch.arange(side, dtype=torch.float64) / side
    samples = Samples.of(problem, torch.cartesian_prod(axis, axis))
    L = Generator.of(problem, samples)
    V, log_mu = (zoo.rough_network(2, seed, size=0.3) for seed in (5, 6))
    w = zoo.rough_network(2, seed=7, outputs=problem.control_dim)
    with torch.no_grad():
        (_, inflow), (mu, outflow) = L.control_inflow(w), L.occupation_outflow(log_mu)
        charged = L.multiplier_term(L.jet(V), mu, w(samples.x)).mean()
        given = (V(samples.x) * (inflow - outflow - samples.mu0)).mean()
    torch.testing.assert_close(charged, given, rtol=1e-5, atol=1e-5)


def test_more_motions_than_coordinates_become_as_many_of_the_same_law():
    problem = Kuramoto(phase_noise=[0.1, 0.2, 0.3], noise=[0.01, 0.02])
    sigma = problem.noise(torch.zeros(1, 2).double())[0]
    assert sigma.shape == (2, 2)
    parted = torch.tensor([[0.1, 0.0, -0.3], [0.0, 0.2, -0.3]], dtype=torch.float64) / TURN
    torch.testing.assert_close(sigma @ sigma.T, parted @ parted.T + torch.tensor([[0.02, 0.0], [0.0, 0.04]]).double())
