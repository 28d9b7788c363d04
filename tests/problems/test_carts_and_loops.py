"""Cart and pole, double integrator and phase-locked loop: the physics they claim to be, and the truth they declare."""

import math

import numpy as np
import pytest
import torch

from ocp_torch.maths.brownian import Grid, increments, path_integral
from ocp_torch.maths.runge_kutta import discounted_integral
from ocp_torch.problems import CartPole, DoubleIntegrator, PhaseLockedLoop
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.systems.rest import linearised, riccati
from ocp_torch.runs.metrics.classical import classical_policy
from ocp_torch.runs.metrics.feedback import regulator
from ocp_torch.studies.reference.reference import solve_reference
from support import zoo

ROUNDING = dict(rtol=1e-9, atol=1e-9)
CARTS = [CartPole(), CartPole(gravity=3.0, cart_mass=0.4, pole_mass=0.7, half_length=0.8)]


def inside(system, count: int, seed: int = 0):
    """States in the box, ``(count, d)``, in physical units."""
    draws = torch.rand(count, system.dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5
    return system.chart.centre + 0.8 * system.chart.length * draws


def gradient(function, s):
    at = s.clone().requires_grad_(True)
    return torch.autograd.grad(function(at).sum(), at)[0]


# Cart and pole.
@pytest.mark.parametrize("cart", CARTS)
def test_the_cart_moves_as_the_lagrangian_of_all_its_points_says(cart):
    """`L_vv q'' = L_q - L_vq v + F`, with the energies summed over the points of the rod by quadrature."""
    nodes, weights = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(3))
    radius, part = cart.half_length * (nodes + 1.0), 0.5 * cart.pole_mass * weights

    def lagrangian(q, v):
        along, up = v[0] + radius * q[1].cos() * v[1], -radius * q[1].sin() * v[1]
        kinetic = 0.5 * cart.cart_mass * v[0] ** 2 + 0.5 * (part * (along**2 + up**2)).sum()
        return kinetic - cart.gravity * (part * radius * q[1].cos()).sum()

    for k, s in enumerate(inside(cart, 20)):
        q, v, force = s[:2], s[2:], torch.tensor([3.0 * (-1.0) ** k, 0.0], dtype=torch.float64)
        mass = torch.func.hessian(lagrangian, 1)(q, v)
        mixed = torch.func.jacrev(torch.func.grad(lagrangian, 1), 0)(q, v)
        expected = torch.linalg.solve(mass, torch.func.grad(lagrangian, 0)(q, v) - mixed @ v + force)
        a, B = cart.dynamics(s[None])
        torch.testing.assert_close((a + B[..., 0] * force[0])[0], torch.cat([v, expected]), **ROUNDING)


@pytest.mark.parametrize("cart", CARTS)
def test_the_force_alone_changes_the_energy_by_the_work_it_does(cart):
    s = inside(cart, 200)
    a, B = cart.dynamics(s)
    slope = gradient(cart.energy, s)
    torch.testing.assert_close((slope * a).sum(dim=-1), torch.zeros(200).double(), **ROUNDING)
    torch.testing.assert_close((slope * B[..., 0]).sum(dim=-1), s[:, 2], **ROUNDING)


def test_energy_is_kept_along_paths_also_where_time_is_slowed_down():
    cart = CartPole()
    start = torch.tensor([[0.0, 3.0, 0.5, 1.0], [0.0, 0.2, -0.3, 0.0], [2.0, 1.0, 2.0, 9.0]], dtype=torch.float64)
    _, end = discounted_integral(lambda x: (cart.drift(x), x[:, 0]), cart.to_torus(start), 1.0, 2.0, 600)
    end = cart.from_torus(end)
    assert bool(cart.chart.outside(end).any())
    torch.testing.assert_close(cart.energy(end), cart.energy(start), rtol=0.0, atol=1e-6)


def test_it_is_gymnasiums_cart_and_pole():
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make("CartPole-v1").unwrapped
    cart = CartPole()
    for action, s in enumerate(inside(cart, 40)):
        env.reset(seed=0)
        env.steps_beyond_terminated = None
        before = s * torch.tensor([0.5, 0.05, 1.0, 1.0], dtype=torch.float64)  # near upright, where it steps
        env.state = before[[0, 2, 1, 3]].numpy()
        env.step(action % 2)
        theirs = (torch.as_tensor(np.array(env.state, dtype=np.float64))[[0, 2, 1, 3]] - before) / env.tau
        a, B = cart.dynamics(before[None])
        force = env.force_mag if action % 2 else -env.force_mag
        torch.testing.assert_close((a + B[..., 0] * force)[0], theirs, rtol=1e-4, atol=1e-4)


def test_a_mirrored_cart_does_the_mirrored_thing():
    cart = CartPole()
    x = cart.to_torus(inside(cart, 50))
    mirrored = (-x).remainder(1.0)
    torch.testing.assert_close(cart.drift(mirrored), -cart.drift(x), **ROUNDING)
    torch.testing.assert_close(cart.control_matrix(mirrored), cart.control_matrix(x), **ROUNDING)
    torch.testing.assert_close(cart.state_cost(mirrored), cart.state_cost(x), **ROUNDING)


@pytest.mark.nightly
def test_the_balance_near_upright_is_that_of_the_linear_system():
    """By difference quotients; and what balancing costs in all is the quadratic form."""
    cart = CartPole(control_limit=None)
    A, B, Q = linearised(cart, [0.0] * 4)
    h = 1e-5
    steps = h * torch.eye(4, dtype=torch.float64)
    quotients = (cart.dynamics(steps)[0] - cart.dynamics(-steps)[0]) / (2.0 * h)
    torch.testing.assert_close(A.T, quotients, rtol=0.0, atol=1e-7)
    assert Q.diag().tolist() == pytest.approx([0.2, 1.0, 0.02, 0.02])
    P, gain = regulator(cart, (0.0,) * 4)
    torch.testing.assert_close(A.T @ P + P @ A - gain.T @ gain + Q, 0.0 * P, rtol=0.0, atol=1e-9)
    assert float(torch.linalg.eigvals(A - B @ gain).real.max()) < 0.0
    start = 0.01 * torch.tensor([[1.0, 1.0, 0.0, 0.0], [0.0, -1.0, 1.0, 2.0]], dtype=torch.float64)
    policy = classical_policy(cart)

    def rates(x):
        u = policy(x)
        return cart.velocity(x, u), cart.state_cost(x) + cart.control_cost.cost(u)

    paid, _ = discounted_integral(rates, cart.to_torus(start), 1e-9, 16.0, 400)
    expected = 0.5 * ((start @ P) * start).sum(dim=-1)
    torch.testing.assert_close(paid / 1e-9, expected, rtol=2e-3, atol=0.0)


def test_the_noise_of_the_force_is_a_force():
    cart = CartPole(force_noise=0.7)
    s = inside(cart, 20)
    torch.testing.assert_close(cart.disturbance(s), 0.7 * cart.dynamics(s)[1])


# The double integrator.
def on_grid(system, side: int):
    """States of the torus ``(side^2, 2)`` and their physical states."""
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    x = torch.cartesian_prod(axis, axis)
    return x, system.from_torus(x)


def test_riccatis_equation_has_the_solution_of_the_textbook():
    A, B = torch.tensor([[0.0, 1.0], [0.0, 0.0]]).double(), torch.tensor([[0.0], [1.0]]).double()
    root = math.sqrt(3.0)
    expected = torch.tensor([[root, 1.0], [1.0, root]], dtype=torch.float64)
    torch.testing.assert_close(riccati(A, B, torch.eye(2).double()), expected, **ROUNDING)
    # Discounted in one dimension: F = -rho/2, P = sqrt(rho^2 / 4 + q) - rho/2.
    one = torch.ones(1, 1, dtype=torch.float64)
    assert float(riccati(0.0 * one, one, 3.0 * one, 2.0)) == pytest.approx(1.0)


@pytest.mark.parametrize("options", [{}, dict(starts=[0.4, 0.3], mass=2.0), dict(force_noise=0.4)])
def test_the_optimum_is_the_mean_of_the_quadratic_over_the_start(options):
    system = DoubleIntegrator(**options)
    x, s = on_grid(system, 1000)
    mean = float((system.plane.value(s) * system.initial_density(x)).mean())
    assert system.lqr_optimum == pytest.approx(mean, rel=1e-5)


@pytest.mark.parametrize("options", [{}, dict(mass=0.5, velocity_weight=1.0), dict(force_noise=0.5)])
def test_the_quadratic_is_a_subsolution_of_the_box_up_to_the_seams_and_solves_it_inside(options):
    """Its slack is the one of the docstring, from the package's generator and autograd."""
    system = DoubleIntegrator(**options)
    x, s = on_grid(system, 60)
    L = Generator.of(system, Samples.of(system, x))
    with torch.no_grad():
        slack = L.hjb_slack(L.jet(lambda x: system.plane.value(system.from_torus(x))))
        chi, V = system.chart.cut(s), system.plane.value(s)
        price = 0.5 * system.plane.control(s).square().sum(dim=-1)
        c = system.plane.constant
        expected = (1.0 - chi) * (V - system.failure_cost + chi * (c - price))
    torch.testing.assert_close(slack, expected, rtol=1e-9, atol=1e-9)
    assert float(slack.max()) <= 1e-9
    assert bool((chi < 1.0).any())


def test_the_linear_controller_pays_the_quadratic_from_every_start_and_keeps_to_the_box():
    system = DoubleIntegrator()
    half = torch.tensor(system.starts, dtype=torch.float64)
    s = half * (2.0 * torch.rand(300, 2, generator=torch.Generator().manual_seed(0)).double() - 1.0)
    policy = classical_policy(system)

    def rates(x):
        u = policy(x)
        return system.velocity(x, u), system.state_cost(x) + system.control_cost.cost(u)

    paid, _ = discounted_integral(rates, system.to_torus(s), system.discount, 8.0, 300)
    torch.testing.assert_close(paid, system.plane.value(s), rtol=1e-4, atol=1e-6)
    assert system.exact_optimum == system.lqr_optimum


@pytest.mark.parametrize("limit", [math.inf, 0.9])
@pytest.mark.parametrize("size", [0.3, 0.5, 0.6, 0.7, 0.8, 0.95])
def test_paths_stay_where_they_are_said_to(size, limit):
    """Against the peaks of paths from the corners, by matrix exponentials: sure where it says so, and not timid."""
    system = DoubleIntegrator(velocity_weight=0.3)
    plane, box = system.plane, torch.tensor(system.box, dtype=torch.float64)
    half = size * torch.tensor([1.0, 0.8], dtype=torch.float64)
    closed = plane.A - plane.B @ plane.B.T @ plane.P
    corners = torch.stack([half, half * torch.tensor([1.0, -1.0])])
    times = torch.linspace(0.0, 12.0, 2000, dtype=torch.float64)
    paths = torch.einsum("kij,nj->kni", torch.linalg.matrix_exp(times[:, None, None] * closed), corners).flatten(0, 1)
    peak = max(float((paths.abs() / box).max()), float(plane.control(paths).abs().max()) / limit)
    says = plane.stays(half, box, limit)
    assert says == (peak <= 1.0) or 0.97 < peak <= 1.0


@pytest.mark.parametrize(
    ("options", "exact", "below"),
    [
        (dict(starts=[0.9, 0.6]), False, True),
        (dict(control_limit=0.3), False, True),
        (dict(control_limit=1.5), True, True),
        (dict(failure_cost=1.0), False, False),
        (dict(force_noise=0.1), False, True),
        (dict(noise=0.001), False, False),
    ],
)
def test_the_optimum_is_declared_only_where_it_is_known(options, exact, below):
    system = DoubleIntegrator(**options)
    assert (system.exact_optimum is not None, system.lqr_optimum is not None) == (exact, below)
    assert system.occupation_bound is None or exact


@pytest.mark.parametrize("options", [{}, dict(starts=[0.5, 0.2], mass=1.5)])
def test_the_optimal_density_is_bounded_as_declared(options):
    """`mu*(s) = int rho e^{-(rho - k) t} mu0(flow of -t) dt`, by quadrature: its mass is 1, and it is largest at rest."""
    system = DoubleIntegrator(**options)
    plane, rho = system.plane, system.discount
    closed = plane.A - plane.B @ plane.B.T @ plane.P
    k = -float(closed.trace())
    assert plane.contraction == pytest.approx(k)
    _, s = on_grid(system, 80)
    h, total = 0.02, torch.zeros(len(s), dtype=torch.float64)
    back = torch.linalg.matrix_exp(-h * closed).T
    flow = s @ torch.linalg.matrix_exp(-0.5 * h * closed).T
    for step in range(400):
        within = (flow.abs() <= torch.tensor(system.box)).all(dim=-1)
        mu0 = torch.zeros_like(total)
        mu0[within] = system.initial_density(system.to_torus(flow[within]))
        total += h * rho * math.exp(-(rho - k) * (step + 0.5) * h) * mu0
        flow = flow @ back
    assert float(total.mean()) == pytest.approx(1.0, abs=5e-3)
    assert 0.95 * system.occupation_bound <= float(total.max()) <= 1.001 * system.occupation_bound


@pytest.mark.parametrize(("weight", "bounded"), [(4.0, True), (100.0, False)])
def test_the_density_has_no_bound_where_the_flow_contracts_faster_than_the_discount_forgets(weight, bounded):
    assert math.isfinite(DoubleIntegrator(position_weight=weight, starts=[0.4, 0.2]).occupation_bound) == bounded


@pytest.mark.nightly
def test_the_grid_knows_nothing_of_riccati_and_finds_the_same_optimum():
    """In the box, with its cut-off and its failures."""
    system = DoubleIntegrator()
    found = solve_reference(system, side=64)
    assert abs(found.optimum - system.exact_optimum) <= found.error
    assert found.error <= 0.1 * system.exact_optimum


# The phase-locked loop.
def test_a_free_oscillator_strays_as_the_model_of_two_states_does():
    """`var phi = n_1^2 t + n_2^2 t^3 / 3`, `var w = n_2^2 t`, `cov = n_2^2 t^2 / 2`."""
    loop, paths, t = PhaseLockedLoop(phase_noise=0.2, frequency_noise=0.3), 4096, 1.5
    x = torch.zeros(paths, 2, dtype=torch.float64)
    grid = Grid(torch.full((paths,), t, dtype=torch.float64), 64, 1.0)
    moves = increments(grid, 2, 0, 0, 0)
    end = path_integral(
        lambda y: (loop.drift(y), torch.zeros_like(y[:, 0])), loop.noise, x, grid, moves, lambda horizon, part: horizon
    )[1]
    found = torch.cov(loop.from_torus(end).T)
    expected = torch.tensor([[0.04 * t + 0.09 * t**3 / 3.0, 0.09 * t**2 / 2.0], [0.09 * t**2 / 2.0, 0.09 * t]]).double()
    size = expected.diagonal().sqrt()
    assert float(((found - expected) / (size[:, None] * size)).abs().max()) < 5.0 * math.sqrt(2.0 / paths)


def test_the_classical_loop_has_its_natural_frequency_and_damping():
    loop = PhaseLockedLoop()
    policy = classical_policy(loop)
    closed = torch.func.jacrev(lambda x: loop.velocity(x[None], policy(x[None]))[0])(
        torch.zeros(2, dtype=torch.float64)
    )
    # s^2 + 2 zeta w_n s + w_n^2 with 0.707 and 1 rad/s.
    assert (-float(closed.trace()), float(closed.det())) == (pytest.approx(1.414), pytest.approx(1.0))


def test_both_paths_of_the_loop_cost_what_they_say():
    loop = PhaseLockedLoop(tuning_weight=[0.5, 0.1], control_limit=None)
    u = torch.tensor([[2.0, -3.0]], dtype=torch.float64)
    assert float(loop.control_cost.cost(loop.to_controls(u))) == pytest.approx(0.5 * (0.5 * 4.0 + 0.1 * 9.0))
    s = torch.tensor([[0.3, 1.0]], dtype=torch.float64)
    assert float(loop.state_cost(loop.to_torus(s))) == pytest.approx(1.0 - math.cos(0.3) + 0.1)
    x = loop.to_torus(s)
    moved = loop.velocity(x, loop.to_controls(u)) * loop.chart.lengths(x)
    assert moved[0].tolist() == pytest.approx([1.0 - 2.0, 3.0])
    assert zoo.build("phase-locked loop").noisy
