"""Arms, vehicles, oscillators, neurons and a pendulum: periodic, and the physics they claim to be."""

import cmath
import math

import numpy as np
import pytest
import torch
from scipy.linalg import solve_continuous_are

from ocp_torch import System
from ocp_torch.control.described import problem_name
from ocp_torch.errors import InputError
from ocp_torch.maths.runge_kutta import discounted_integral
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems import (
    PROBLEMS,
    Acrobot,
    Arm,
    CartPole,
    DoubleIntegrator,
    Dubins,
    Kuramoto,
    Pendubot,
    Pendulum,
    PhaseLockedLoop,
    PhaseNeurons,
    Quadrotor,
    RobotArm,
    Satellite,
    Unicycle,
)
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.systems.rest import occupation_bound_at_rest, optimal_contraction
from ocp_torch.runs.metrics.measures import measure, simulate
from ocp_torch.runs.metrics.trial import metrics
from ocp_torch.studies.reference.reference import solve_reference
from support import zoo
from support.refusals import refused

ROUNDING = dict(rtol=1e-9, atol=1e-9)
TURN = 2.0 * math.pi


def physical(problem, count: int, seed: int = 0):
    """Physical states in the units of the problem, far beyond one turn where they are angles."""
    draws = torch.rand(count, len(problem.from_torus(torch.zeros(1, problem.dim))[0]), generator=generator(seed)) - 0.5
    states = 40.0 * draws.double()
    if isinstance(problem, System):
        chart = problem.chart
        states[:, chart.boxed] = (chart.centre + chart.length * draws)[:, chart.boxed]
    return states


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def riccati(A, B, Q, rho: float):
    """`P` with `V(x) = rho x'Px / 2` for the linear dynamics and the cost `rho int e^{-rho t} (x'Qx + |u|^2) / 2 dt`."""
    shifted = A - 0.5 * rho * torch.eye(len(A), dtype=A.dtype)
    return torch.from_numpy(solve_continuous_are(shifted.numpy(), B.numpy(), Q.numpy(), np.eye(B.shape[1])))


def same_turns(a, b):
    """Angles in radians that may differ by whole turns."""
    away = torch.exp(1j * a) - torch.exp(1j * b)
    torch.testing.assert_close(away, torch.zeros_like(away), rtol=0.0, atol=1e-9)


@zoo.on(zoo.NATURAL)
def test_every_function_has_period_one_in_each_coordinate(problem):
    x = zoo.states(problem, 200)
    names = ["state_cost", "drift", "control_matrix", "drift_divergence", "control_divergence"]
    for shift in (*torch.eye(problem.dim, dtype=torch.float64), torch.full((problem.dim,), -3.0, dtype=torch.float64)):
        for name in names:
            function = getattr(problem, name)
            torch.testing.assert_close(function(x + shift), function(x), **ROUNDING, msg=name)


@zoo.on(zoo.NATURAL)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_functions_give_the_documented_shapes_in_the_precision_asked_for(problem, dtype):
    d, m, x = problem.dim, problem.control_dim, zoo.states(problem, 7, dtype=dtype)
    samples = Samples.of(problem, x)
    shapes = {"f": (7,), "a": (7, d), "B": (7, d, m), "mu0": (7,), "div_a": (7,), "div_B": (7, m)}
    assert {name: tuple(getattr(samples, name).shape) for name in shapes} == shapes
    assert {getattr(samples, name).dtype for name in shapes} == {dtype}


@zoo.on(zoo.NATURAL)
def test_divergences_are_those_of_difference_quotients(problem):
    x, h = zoo.states(problem, 300, seed=1), 1e-5
    div_a, div_B = torch.zeros(300, dtype=torch.float64), torch.zeros(300, problem.control_dim, dtype=torch.float64)
    for i, e in enumerate(h * torch.eye(problem.dim, dtype=torch.float64)):
        div_a += (problem.drift(x + e) - problem.drift(x - e))[:, i] / (2.0 * h)
        div_B += (problem.control_matrix(x + e) - problem.control_matrix(x - e))[:, i] / (2.0 * h)
    torch.testing.assert_close(problem.drift_divergence(x), div_a, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(problem.control_divergence(x), div_B, rtol=1e-4, atol=1e-5)


@zoo.on(zoo.NATURAL)
def test_the_state_cost_has_a_second_derivative_without_jumps(problem):
    """Along random lines: second differences of a twice differentiable function change little over a small step."""
    x, way = (
        zoo.states(problem, 400, seed=2),
        torch.randn(400, problem.dim, generator=generator(3), dtype=torch.float64),
    )
    way = way / way.norm(dim=-1, keepdim=True)
    f = lambda t: problem.state_cost(x + t * way)
    second = lambda t, h: (f(t + h) - 2.0 * f(t) + f(t - h)) / h**2
    change = lambda h: float((second(8.0 * h, h) - second(0.0, h)).abs().max())
    assert change(2e-4) <= 0.25 * change(2e-3) + 1e-5 * problem.state_cost_bound


@zoo.on(zoo.NATURAL)
def test_the_state_cost_stays_between_zero_and_its_bound_also_at_its_extremes(problem):
    x = zoo.states(problem, 2**13, seed=5)
    most = supremum(problem.state_cost, x, ascents=32, steps=60).value
    least = -supremum(lambda y: -problem.state_cost(y), x, ascents=32, steps=60).value
    assert -1e-10 <= least <= most <= problem.state_cost_bound * (1.0 + 1e-9)


@zoo.on(zoo.NATURAL)
def test_physical_coordinates_and_states_are_one_to_one(problem):
    x = zoo.states(problem, 200, seed=7)
    off = problem.to_torus(problem.from_torus(x)) - x
    torch.testing.assert_close(off - off.round(), torch.zeros_like(x), **ROUNDING)
    states = problem.to_torus(physical(problem, 200))
    assert bool(((states >= 0.0) & (states < 1.0)).all())
    again = problem.to_torus(problem.from_torus(states)) - states
    torch.testing.assert_close(again - again.round(), torch.zeros_like(states), **ROUNDING)


@zoo.on(zoo.NATURAL)
def test_a_problem_is_made_again_from_its_parameters(problem):
    name = problem_name(problem)
    again = PROBLEMS[name](**problem.parameters)
    x = zoo.states(problem, 50, seed=8)
    for function in ("state_cost", "drift", "control_matrix"):
        assert torch.equal(getattr(again, function)(x), getattr(problem, function)(x))
    assert (again.discount, again.exponent, again.parameters) == (
        problem.discount,
        problem.exponent,
        problem.parameters,
    )


# The arm.
def test_the_arm_ends_where_a_sum_of_complex_numbers_does():
    arm = zoo.build("arm n=3 q=1.5")
    for angles in (TURN * torch.rand(20, 3, generator=generator(0), dtype=torch.float64)).tolist():
        total, end = 0.0, 0.0
        for length, angle in zip(arm.lengths, angles, strict=True):
            total += angle
            end += cmath.rect(length, total)
        found = arm.end_effector(torch.tensor([angles], dtype=torch.float64))[0]
        assert complex(*found.tolist()) == pytest.approx(end, abs=1e-12)


def test_the_arms_cost_is_its_formula_point_by_point():
    arm = Arm(dim=2, lengths=[0.6, 0.4], obstacles=[[0.5, 0.1, 0.1], [-0.3, 0.3, 0.2]], obstacle_weight=2.5)
    for x in torch.rand(60, 2, generator=generator(1), dtype=torch.float64):
        first = 0.6 * cmath.exp(1j * TURN * float(x[0]))
        second = first + 0.4 * cmath.exp(1j * TURN * float(x.sum()))
        expected = abs(second - complex(*arm.target)) ** 2
        points = [first * k / 8 for k in range(1, 9)] + [first + (second - first) * k / 8 for k in range(1, 9)]
        for cx, cy, radius in arm.obstacles:
            missed = 1.0
            for point in points:
                square = abs(point - complex(cx, cy)) ** 2 / (radius + arm.clearance) ** 2
                missed *= 1.0 - max(0.0, 1.0 - square) ** 3
            expected += 2.5 * (1.0 - missed)
        assert float(arm.state_cost(x.unsqueeze(0))) == pytest.approx(expected, rel=1e-10)


def test_the_gap_to_an_obstacle_is_that_of_many_points_on_the_links():
    arm = Arm(dim=3, obstacles=[[0.5, 0.1, 0.1], [-0.3, 0.3, 0.2]])
    x = zoo.states(arm, 100, seed=3)
    joints = arm.joints(arm.from_torus(x))
    s = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64).reshape(-1, 1)
    points = torch.cat([joints[:, i : i + 1] + s * (joints[:, i + 1] - joints[:, i]).unsqueeze(1) for i in range(3)], 1)
    near = [(points - torch.tensor(o[:2])).norm(dim=-1).amin(dim=1) - o[2] for o in arm.obstacles]
    torch.testing.assert_close(arm.gap(x), torch.minimum(*near), rtol=0.0, atol=1e-4)


def test_an_arm_without_obstacles_is_the_same_after_a_turn_of_everything():
    turned = Arm(target=[-0.65, 0.2], obstacles=[])  # the default target, a quarter turn on
    x = zoo.states(turned, 100)
    torch.testing.assert_close(
        turned.state_cost(x + torch.tensor([0.25, 0.0])), Arm(obstacles=[]).state_cost(x), **ROUNDING
    )


# Vehicles.
def test_a_unicycle_does_not_slide_sideways_and_goes_as_fast_as_it_says():
    unicycle = Unicycle(size=5.0, speed=2.0, turn_rate=0.5)
    x, u = zoo.states(unicycle, 100), torch.randn(100, 2, generator=generator(0), dtype=torch.float64)
    velocity, ahead = unicycle.velocity(x, u), unicycle.heading(unicycle.from_torus(x))
    metres = 5.0 * velocity[:, :2]
    torch.testing.assert_close(metres, 2.0 * u[:, :1] * ahead, **ROUNDING)
    torch.testing.assert_close(velocity[:, 2], 0.5 * u[:, 1], **ROUNDING)


def test_dubins_goes_straight_without_control_and_in_a_circle_under_a_constant_one():
    dubins = Dubins(size=4.0, speed=1.0, turn_rate=0.25)
    x0 = zoo.states(dubins, 20)
    run = lambda u, time: discounted_integral(
        lambda x: (dubins.velocity(x, torch.full((len(x), 1), u, dtype=x.dtype)), x[:, 0]),
        x0,
        1.0,
        time,
        400,
        wrap=False,
    )[1]
    straight = 4.0 * (run(0.0, 3.0) - x0)[:, :2]
    torch.testing.assert_close(straight, 3.0 * dubins.heading(dubins.from_torus(x0)), **ROUNDING)
    # u = 1 is a quarter turn a second: closed after four.
    torch.testing.assert_close(run(1.0, 4.0) - x0, torch.tensor([[0.0, 0.0, 1.0]] * 20).double(), rtol=0.0, atol=1e-8)


def test_a_vehicles_cost_is_the_square_distance_near_the_target():
    unicycle = Unicycle(obstacles=[], target_weight=3.0)
    near = unicycle.to_torus(torch.tensor([[2.01, 2.02, 0.3]], dtype=torch.float64))
    assert float(unicycle.state_cost(near)) == pytest.approx(3.0 * (0.01**2 + 0.02**2), rel=1e-3)
    assert float(unicycle.distance(near)) == pytest.approx(math.hypot(0.01, 0.02), rel=1e-9)


def test_a_room_is_the_plane_up_to_its_walls_and_as_far_across_as_it_is():
    plane, room = Unicycle(obstacles=[], target=[3.5, 2.0]), Unicycle(obstacles=[], target=[3.5, 2.0], walls=True)
    s = torch.rand(100, 3, generator=generator(0), dtype=torch.float64) * torch.tensor([4.0, 4.0, TURN])
    u = torch.randn(100, 2, generator=generator(1), dtype=torch.float64)
    rates = [p.velocity(p.to_torus(s), u) * p.chart.length for p in (plane, room)]
    torch.testing.assert_close(*rates)
    near = torch.tensor([[3.49, 2.02, 1.0], [0.5, 2.0, 1.0]], dtype=torch.float64)
    assert plane.distance(plane.to_torus(near)).tolist() == pytest.approx([math.hypot(0.01, 0.02), 1.0])
    assert room.distance(room.to_torus(near)).tolist() == pytest.approx([math.hypot(0.01, 0.02), 3.0])
    assert room.state_cost(room.to_torus(near)).tolist() == pytest.approx([0.01**2 + 0.02**2, 9.0])


def test_a_vehicle_that_drives_into_a_wall_stops_there_and_pays_for_the_failure_for_ever():
    """By default as much as the farthest corner, 2 m from the target both ways."""
    dubins = Dubins(walls=True)
    s = torch.tensor([[3.0, 2.0, 0.1], [1.0, 1.0, -2.0]], dtype=torch.float64)
    path = simulate(dubins, lambda x: torch.zeros_like(x[:, :1]), dubins.to_torus(s), 20.0, 200)
    end = path.states[-1]
    assert bool(dubins.outside(end).all())
    torch.testing.assert_close(dubins.state_cost(end), torch.full((2,), 8.0).double(), rtol=0.02, atol=0.0)
    assert measure(dubins, path)["left"] == 1.0
    assert float(dubins.initial_density(end).max()) == 0.0


# Oscillators.
@pytest.mark.parametrize("name", ["kuramoto n=3 absolute", "kuramoto entrain"])
def test_the_drift_is_the_double_sum(name):
    kuramoto = zoo.build(name)
    theta = TURN * torch.rand(kuramoto.oscillators, generator=generator(2), dtype=torch.float64)
    found = TURN * kuramoto.drift(kuramoto.to_torus(theta.unsqueeze(0)))[0]
    A, n = kuramoto._adjacency, kuramoto.oscillators
    for i in range(n):
        pulled = sum(float(A[i, j]) * math.sin(float(theta[j] - theta[i])) for j in range(n))
        assert float(found[i]) == pytest.approx(kuramoto.frequencies[i] + kuramoto.coupling / n * pulled, abs=1e-10)


@pytest.mark.parametrize("goal", ["synchronise", "desynchronise"])
def test_relative_phases_follow_the_absolute_ones(goal):
    options = dict(oscillators=4, graph="random", controlled=[1, 3], goal=goal, coupling=1.5, seed=5)
    absolute, relative = Kuramoto(relative=False, **options), Kuramoto(**options)
    theta = TURN * torch.rand(50, 4, generator=generator(1), dtype=torch.float64)
    x, y = absolute.to_torus(theta), relative.to_torus(theta)
    u = torch.randn(50, 2, generator=generator(2), dtype=torch.float64)
    torch.testing.assert_close(absolute.state_cost(x), relative.state_cost(y), **ROUNDING)
    torch.testing.assert_close(absolute.drift_divergence(x), relative.drift_divergence(y), **ROUNDING)
    fast, slow = absolute.velocity(x, u), relative.velocity(y, u)
    torch.testing.assert_close(fast[:, :-1] - fast[:, -1:], slow, **ROUNDING)


@pytest.mark.nightly
def test_absolute_and_relative_phases_have_the_same_optimum():
    options = dict(oscillators=2, coupling=0.4, spread=0.8, seed=1)
    line = solve_reference(Kuramoto(**options), side=256)
    square = solve_reference(Kuramoto(relative=False, **options), side=64)
    # In the plane two controls push the same phase difference; grids agree to three digits, but show no order.
    assert square.error is None
    assert abs(line.optimum - square.optimum) <= 2.0 * line.error + 1e-3 * line.optimum
    assert line.error <= 0.02 * line.optimum


def test_the_order_parameter_is_one_in_synchrony_and_zero_in_a_splay_state():
    kuramoto = Kuramoto(oscillators=5)
    together, splay = (
        torch.zeros(1, 5, dtype=torch.float64),
        TURN * torch.arange(5.0, dtype=torch.float64).reshape(1, 5) / 5,
    )
    order = lambda theta: float(kuramoto.order_parameter(kuramoto.to_torus(theta + 0.7)))
    assert (order(together), order(splay)) == (pytest.approx(1.0), pytest.approx(0.0, abs=1e-12))


@pytest.mark.parametrize("seed", range(6))
def test_a_random_graph_is_symmetric_and_connected_and_follows_its_seed(seed):
    make = lambda s: Kuramoto(oscillators=9, graph="random", probability=0.1, seed=s)._adjacency
    A = make(seed)
    assert torch.equal(A, A.T)
    assert torch.equal(A, make(seed))
    assert not torch.equal(A, make(seed + 100))
    assert bool((torch.linalg.matrix_power(A + torch.eye(9, dtype=A.dtype), 8) > 0.0).all())


def test_the_extremes_of_a_random_graph_are_a_tree_and_the_complete_graph():
    edges = lambda p: float(Kuramoto(oscillators=8, graph="random", probability=p)._adjacency.sum()) / 2
    assert (edges(0.0), edges(1.0)) == (7, 28)


@pytest.mark.parametrize("suffix", [".npy", ".txt"])
def test_a_graph_from_a_file_is_that_of_the_same_rows_and_is_saved_without_the_file(tmp_path, suffix):
    rows, path = [[0, 1, 0.5], [1, 0, 0], [0, 2, 0]], tmp_path / f"graph{suffix}"
    np.save(path, np.array(rows)) if suffix == ".npy" else np.savetxt(path, rows)
    read = Kuramoto(graph=str(path))
    assert torch.equal(read._adjacency, torch.tensor(rows, dtype=torch.float64))
    path.unlink()
    assert torch.equal(Kuramoto(**read.parameters)._adjacency, read._adjacency)


def test_files_that_are_no_adjacency_are_refused_in_one_sentence(tmp_path):
    path = tmp_path / "graph.npy"
    np.save(path, np.array([[0, {}], [1, 0]], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="not a matrix of numbers"):
        Kuramoto(oscillators=2, graph=str(path))
    path.write_bytes(b"\x93NUMPY\x01\x00v")
    with pytest.raises(InputError, match="not a matrix of numbers"):
        Kuramoto(oscillators=2, graph=str(path))
    np.save(path, np.ones((2, 3)))
    with pytest.raises(InputError, match=r"shape \(2, 3\), but must be a 2 by 2"):
        Kuramoto(oscillators=2, graph=str(path))
    np.save(path, np.array([[0.0, np.nan], [1.0, 0.0]]))
    with pytest.raises(InputError, match="not finite"):
        Kuramoto(oscillators=2, graph=str(path))
    with pytest.raises(InputError, match="cannot be read"):
        Kuramoto(oscillators=2, graph=str(tmp_path / "none.txt"))


# Neurons.
@pytest.mark.parametrize("response", ["type1", "type2"])
def test_no_stimulus_parts_equal_neurons_that_fire_together(response):
    neurons = PhaseNeurons(neurons=3, response=response, spread=0.0)
    x = torch.rand(50, 1, generator=generator(0), dtype=torch.float64).expand(-1, 3)
    velocity = neurons.velocity(x, torch.randn(50, 1, generator=generator(1), dtype=torch.float64))
    torch.testing.assert_close(velocity, velocity[:, :1].expand(-1, 3), **ROUNDING)


def test_neurons_without_stimulus_are_kuramoto_oscillators():
    neurons = PhaseNeurons(neurons=4, coupling=0.7)
    kuramoto = Kuramoto(oscillators=4, relative=False, coupling=0.7, frequencies=neurons.frequencies)
    x = zoo.states(neurons, 50)
    torch.testing.assert_close(neurons.drift(x), kuramoto.drift(x), **ROUNDING)
    torch.testing.assert_close(neurons.drift_divergence(x), kuramoto.drift_divergence(x), **ROUNDING)


def test_phase_responses_vanish_where_their_type_says():
    at = lambda response, theta: float(
        PhaseNeurons(response=response).control_matrix(torch.tensor([[theta / TURN] * 2]))[0, 0]
    )
    assert at("type1", 0.0) == pytest.approx(0.0, abs=1e-6)
    assert at("type1", math.pi) == pytest.approx(2.0 / TURN)
    assert at("type2", math.pi / 2) == pytest.approx(-1.0 / TURN)


# The pendulum.
def test_the_pendulum_accelerates_as_gymnasiums_does():
    pendulum = Pendulum(mass=0.7, length=1.3)
    theta = torch.linspace(-3.0, 3.0, 40, dtype=torch.float64)
    speed, torque = (
        torch.linspace(-7.9, 7.9, 40, dtype=torch.float64),
        torch.linspace(2.0, -2.0, 40, dtype=torch.float64),
    )
    x = pendulum.to_torus(torch.stack([theta, speed], dim=-1))
    velocity = pendulum.velocity(x, (torque / pendulum.max_torque).unsqueeze(-1))
    torch.testing.assert_close(TURN * velocity[:, 0], speed, **ROUNDING)
    expected = 3 * 10.0 / (2 * 1.3) * theta.sin() + 3.0 / (0.7 * 1.3**2) * torque
    torch.testing.assert_close(2.0 * pendulum.seam * velocity[:, 1], expected, **ROUNDING)


def test_its_square_cost_is_gymnasiums_up_to_a_factor_within_the_speed_limit():
    pendulum = Pendulum(torque_cost=0.001, square_cost=True)
    angle, velocity = (torch.linspace(-end, end, 30, dtype=torch.float64) for end in (3.14, 7.99))
    s = torch.cartesian_prod(angle, velocity)
    theirs = s[:, 0].square() + 0.1 * s[:, 1].square()
    torch.testing.assert_close(
        pendulum.state_cost(pendulum.to_torus(s)) / pendulum._scale, theirs, rtol=1e-10, atol=1e-12
    )
    everywhere = pendulum.state_cost(
        pendulum.to_torus(torch.cartesian_prod(angle, torch.linspace(-9.99, 9.99, 50).double()))
    )
    assert everywhere.max() <= pendulum.state_cost_bound


def test_its_cost_is_gymnasiums_near_upright_up_to_a_factor():
    pendulum = Pendulum(torque_cost=0.001)
    x = pendulum.to_torus(torch.tensor([[0.05, 3.0], [-0.02, -7.9]], dtype=torch.float64))
    u = torch.tensor([[0.4], [-1.0]], dtype=torch.float64)
    total = pendulum.state_cost(x) + pendulum.control_cost.cost(u)
    theirs = torch.tensor([0.05**2 + 0.1 * 9.0 + 0.001 * 0.8**2, 0.02**2 + 0.1 * 7.9**2 + 0.001 * 2.0**2]).double()
    torch.testing.assert_close(total / pendulum._scale, theirs, rtol=1e-5, atol=0.0)


@pytest.mark.nightly
def test_the_pendulum_keeps_its_energy_without_control_also_beyond_the_cut_off():
    pendulum = Pendulum()
    start = torch.tensor([[3.0, 0.5], [0.3, 2.0], [1.0, 6.0], [2.0, 8.7]], dtype=torch.float64)
    energy = lambda states: 0.5 * states[:, 1].square() + 15.0 * states[:, 0].cos()
    _, end = discounted_integral(lambda x: (pendulum.drift(x), x[:, 0]), pendulum.to_torus(start), 1.0, 3.0, 3000)
    torch.testing.assert_close(energy(pendulum.from_torus(end)), energy(start), rtol=0.0, atol=1e-3)


def test_time_stands_still_at_the_seam_and_the_speed_cost_is_the_integral_of_what_is_left():
    pendulum = Pendulum()
    seam = torch.tensor([[0.2, 0.5], [0.7, 0.5]], dtype=torch.float64)
    push = torch.ones(2, 1, dtype=torch.float64)
    torch.testing.assert_close(pendulum.velocity(seam, push), torch.zeros_like(seam), **ROUNDING)
    for top in (5.0, 8.5, 9.7):
        v = torch.linspace(0.0, top, 20001, dtype=torch.float64)
        cut = pendulum.chart.cut(torch.stack([torch.zeros_like(v), v], dim=-1))
        integral = float(torch.trapezoid(2.0 * v * cut, v))
        assert float(pendulum._square(torch.tensor([-top]).double())) == pytest.approx(integral, rel=1e-6)


def test_a_speed_beyond_the_seam_is_refused():
    with pytest.raises(InputError, match="beyond the seam"):
        Pendulum().to_torus(torch.tensor([[0.0, 10.5]]))


# Where mu* is unbounded.
def test_the_contraction_of_the_optimal_flow_is_that_of_the_riccati_equation():
    A, B = (torch.randn(3, k, generator=generator(4), dtype=torch.float64) for k in (3, 2))
    Q = torch.eye(3, dtype=torch.float64)
    closed_loop = A - B @ B.T @ riccati(A, B, Q, 1.3)
    assert optimal_contraction(A, B, Q, 1.3) == pytest.approx(-float(closed_loop.trace()), rel=1e-10)


@pytest.mark.parametrize("stiffness", [1.0, 7.9, 8.1, 40.0])
def test_in_one_dimension_the_flow_contracts_too_fast_exactly_from_a_known_stiffness_on(stiffness):
    """`rate = rho (sqrt(1 + 4 k b^2 / rho^2) - 1) / 2`, at least `rho` from `k b^2 = 2 rho^2` on; here `b = 1`, `rho = 2`."""
    scalar = lambda v: torch.tensor([[v]], dtype=torch.float64)
    bound = occupation_bound_at_rest(scalar(0.0), scalar(1.0), scalar(stiffness), 2.0, 2.0)
    assert (bound == math.inf) == (stiffness >= 8.0)
    assert occupation_bound_at_rest(scalar(0.0), scalar(1.0), scalar(stiffness), 2.0, 1.5) is None


@pytest.mark.parametrize("name", ["arm n=2", "kuramoto n=3", "pendulum", "unicycle"])
def test_goals_onto_which_the_flow_contracts_leave_no_bound_on_the_occupation(name):
    assert zoo.build(name).occupation_bound == math.inf


@pytest.mark.nightly
# Truth by the grid.
@zoo.on(["arm n=2", "kuramoto n=3", "phase neurons n=2", "pendulum"])
def test_control_is_worth_something_and_the_grid_says_how_much(problem):
    reference = solve_reference(problem, side=32)
    x0 = zoo.states(problem, 512, seed=1)
    zero, _ = discounted_integral(
        lambda x: (problem.drift(x), problem.state_cost(x)), x0, problem.discount, 8.0 / problem.discount, 400
    )
    assert 0.0 <= float(reference.value.min())
    assert reference.optimum <= 0.95 * float(zero.mean())


BAD = [
    (Arm, dict(lengths=[0.5]), "problem.lengths is .* a list of 2 numbers"),
    (Arm, dict(lengths=[0.5, -0.5]), r"problem.lengths\[1\] is -0.5"),
    (Arm, dict(target=[0.1]), "problem.target"),
    (Arm, dict(obstacles=[[0.1, 0.2]]), r"problem.obstacles\[0\]"),
    (Arm, dict(obstacles=[[0.1, 0.2, 0.0]]), r"problem.obstacles\[0\]\[2\] is 0, but must be above 0"),
    (Arm, dict(obstacles="none"), "problem.obstacles"),
    (Arm, dict(speed=0.0), "problem.speed"),
    (Unicycle, dict(size=-1.0), "problem.size"),
    (Unicycle, dict(target=[1.0, math.nan]), r"problem.target\[1\]"),
    (Dubins, dict(turn_rate="fast"), "problem.turn_rate"),
    (Dubins, dict(failure_cost=5.0), "problem.failure_cost is 5, but nothing fails without problem.walls=true"),
    (Unicycle, dict(walls=True, target=[5.0, 2.0]), "problem.target is .* in the room, from 0 to 4 m"),
    (Unicycle, dict(walls="yes"), "problem.walls"),
    (Pendulum, dict(seam=8.0), "problem.seam is 8, but must be above problem.max_speed"),
    (Pendulum, dict(mass=0), "problem.mass"),
    (CartPole, dict(pole_mass=0.0), "problem.pole_mass is 0, but must be above 0"),
    (CartPole, dict(start={"angle": [0, 1]}), "start names 'angle', but must name coordinates: position, pole"),
    (DoubleIntegrator, dict(box=1.0), "problem.box is 1.0, but must be a list of 2 numbers"),
    (DoubleIntegrator, dict(starts=[0.5, 1.5]), "start has velocity from -1.5 to 1.5 m/s, which is not inside the box"),
    (PhaseLockedLoop, dict(tuning_weight=[0.2]), "problem.tuning_weight is .* a list of 2 numbers"),
    (PhaseLockedLoop, dict(exponent=1.5, tuning_weight=[0.1, 0.2]), "must be the same for all controls"),
    (Acrobot, dict(masses=[1.0]), "problem.masses"),
    (Acrobot, dict(lengths=[0.2, -0.3]), r"problem.lengths\[1\] is -0.3"),
    (Acrobot, dict(inertias=[0.001, 0.001]), "problem.inertias are .* about the joints"),
    (Pendubot, dict(starts="hang"), "problem.starts is 'hang'.*did you mean 'hanging'"),
    (Quadrotor, dict(max_speeds=[3.0, 3.0]), "problem.max_speeds"),
    (Quadrotor, dict(obstacles=[[0.1, 0.2]]), r"problem.obstacles\[0\]"),
    (Quadrotor, dict(thrust_noise=-1.0), "problem.thrust_noise"),
    (Satellite, dict(inertia=[[1.0, 0.0, 0.0]]), "problem.inertia is .* three rows"),
    (
        Satellite,
        dict(inertia=[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 3.0]]),
        "problem.inertia is .* principal moments",
    ),
    (Satellite, dict(inertia=[[2.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]), "problem.inertia is .* symmetric"),
    (Kuramoto, dict(oscillators=1), "problem.oscillators"),
    (Kuramoto, dict(goal="sync"), "problem.goal is 'sync'.*did you mean|problem.goal is 'sync'"),
    (Kuramoto, dict(graph="rings"), "problem.graph is 'rings'.*did you mean 'ring'"),
    (Kuramoto, dict(graph=[[0, 1], [1, 0]]), "problem.graph"),
    (Kuramoto, dict(graph=[[0, 1, 1], [1, 1, 1], [1, 1, 0]]), "diagonal"),
    (Kuramoto, dict(graph=[[0, -1, 1], [1, 0, 1], [1, 1, 0]]), "negative"),
    (Kuramoto, dict(frequencies=[1.0]), "problem.frequencies"),
    (Kuramoto, dict(controlled=[0, 0]), "each oscillator once"),
    (Kuramoto, dict(controlled=[3]), r"problem.controlled\[0\] is 3"),
    (Kuramoto, dict(controlled=[]), "problem.controlled"),
    (Kuramoto, dict(goal="entrain", relative=True), "asks for phases"),
    (PhaseNeurons, dict(response="type3"), "problem.response"),
    (PhaseNeurons, dict(goal="entrain"), "problem.goal"),
    (PhaseNeurons, dict(strength=0.0), "problem.strength"),
]


@pytest.mark.parametrize(("cls", "arguments", "message"), BAD)
def test_wrong_arguments_are_refused_in_one_sentence(cls, arguments, message):
    with refused(message):
        cls(**arguments)


# Control limits.
SOME_LIMITED = [
    Arm(control_limit=0.2),
    Unicycle(control_limit=0.2),
    Dubins(control_limit=0.2),
    Kuramoto(control_limit=0.2),
    PhaseNeurons(control_limit=0.2),
    Pendulum(control_limit=0.2),
    RobotArm(control_limit=0.2),
]


@pytest.mark.parametrize("each", [False, True], ids=["one limit", "a limit for each"])
@pytest.mark.parametrize("problem", SOME_LIMITED, ids=lambda problem: type(problem).__name__)
def test_every_system_takes_a_control_limit_and_pays_infinitely_beyond_it(problem, each):
    limit = [0.2] * problem.control_dim if each else 0.2
    problem = type(problem)(control_limit=limit)
    u = torch.zeros(2, problem.control_dim, dtype=torch.float64)
    u[0, 0], u[1, -1] = 0.199, 0.201
    cost = problem.control_cost.cost(u)
    assert cost.tolist() == [pytest.approx(0.199**2 / 2.0), math.inf]
    assert problem.parameters["control_limit"] == limit
    assert PROBLEMS[problem_name(problem)](**problem.parameters).control_limit == limit
    free = type(problem)()
    assert free.control_limit is None
    assert problem.occupation_bound == free.occupation_bound
    with pytest.raises(InputError, match="problem.control_limit"):
        type(problem)(control_limit=0.0)


@pytest.mark.nightly
def test_a_limit_makes_the_optimum_dearer_but_changes_nothing_near_the_state_of_rest():
    """Why the criterion for an unbounded `mu*` needs no limit: there `V*` is that of the discounted Riccati equation."""
    two = dict(oscillators=2, spread=0.0, coupling=0.2)
    free, limited = Kuramoto(**two), Kuramoto(**two, control_limit=0.2)
    one, other = solve_reference(free, side=512), solve_reference(limited, side=512)
    assert other.optimum - other.error > one.optimum + one.error
    at = torch.zeros(1, 1, dtype=torch.float64)
    A = torch.func.jacrev(lambda x: free.drift(x[None])[0])(at[0])
    Q = torch.func.hessian(lambda x: free.state_cost(x[None])[0])(at[0])
    P = riccati(A, free.control_matrix(at)[0], Q, free.discount)
    near = torch.tensor([[-0.02], [0.01], [0.02]], dtype=torch.float64)
    expected = 0.5 * free.discount * float(P) * near[:, 0].square()
    for found in (one, other):
        value, control = found.interpolate(near)
        torch.testing.assert_close(value, expected, rtol=0.03, atol=0.0)
        assert float(control.norm(dim=-1).max()) < 0.19
    # Far away the limit is felt.
    far = torch.tensor([[0.4]], dtype=torch.float64)
    assert float(other.interpolate(far)[0]) > 1.05 * float(one.interpolate(far)[0])


@pytest.mark.parametrize(
    ("problem", "most"),
    [
        pytest.param(Pendulum(control_limit=0.3), [0.3], marks=pytest.mark.nightly),
        (Unicycle(control_limit=[0.3, 0.1]), [0.3, 0.1]),
    ],
)
def test_the_practitioners_numbers_hold_every_law_to_the_limit(problem, most):
    reckless = lambda x: torch.full_like(x[:, :1], 50.0).expand(-1, len(most))
    at_limit = lambda x: x.new_tensor(most).expand(len(x), -1)
    one, other = (metrics(problem, policy, seed=1, starts=8)["controller"] for policy in (reckless, at_limit))
    assert one == other
    assert math.isfinite(one["cost"])


# Gymnasium's pendulum, by hand: the environment itself is in test_gym.py.
def test_an_observation_of_gymnasiums_pendulum_is_the_state_it_was_made_of():
    pendulum = Pendulum()
    drawn = 2.0 * torch.rand(200, 2, generator=generator(11), dtype=torch.float64) - 1.0
    physical = drawn * torch.tensor([3.0 * math.pi, pendulum.max_speed])
    observed = torch.stack([physical[:, 0].cos(), physical[:, 0].sin(), physical[:, 1]], dim=-1)
    states = np.stack([pendulum.from_observation("Pendulum-v1", row) for row in observed.numpy()])
    off = torch.from_numpy(states) - pendulum.to_torus(physical)
    torch.testing.assert_close(off - off.round(), torch.zeros_like(off), **ROUNDING)
    back = pendulum.from_torus(torch.from_numpy(states))
    same_turns(back[:, 0], physical[:, 0])
    torch.testing.assert_close(back[:, 1], physical[:, 1], **ROUNDING)


def test_the_torque_is_that_of_the_model_and_never_beyond_what_gymnasium_allows():
    pendulum = Pendulum(max_torque=1.5)
    assert pendulum.to_action("Pendulum-v1", np.array([-0.4])).tolist() == [pytest.approx(-0.6)]
    assert pendulum.to_action("Pendulum-v1", np.array([7.0])).tolist() == [1.5]
    # A speed a stranger's variant may show beyond the seam is taken at the seam.
    assert pendulum.from_observation("Pendulum-v1", np.array([1.0, 0.0, 99.0])) == pytest.approx([0.0, 0.5])


def test_the_pendulum_knows_no_other_environment():
    for call in (lambda p: p.from_observation("Acrobot-v1", np.zeros(6)), lambda p: p.to_action("Acrobot-v1", [0.0])):
        words = (
            "Pendulum does not know the environment Acrobot-v1: its gymnasium is 'Pendulum-v1'; set it, and define obs"
        )
        with pytest.raises(InputError, match=words):
            call(Pendulum())
