"""Two poles on a cart: against Lagrange's equations, the cart with one pole, and what its environment shows."""

import math

import numpy as np
import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.maths.runge_kutta import discounted_integral
from ocp_torch.problems import CartPole, InvertedDoublePendulum
from ocp_torch.problems.systems.rest import linearised
from ocp_torch.runs.metrics.classical import classical_policy
from ocp_torch.runs.metrics.measures import measure, simulate

ROUNDING = dict(rtol=1e-9, atol=1e-9)
POLES = InvertedDoublePendulum()
ODD = InvertedDoublePendulum(
    masses=[0.8, 0.3, 0.5],
    lengths=[0.7, 0.4],
    centres=[0.2, 0.3],
    inertias=[0.02, 0.01],
    damping=[0.4, 0.03, 0.07],
    gravity=3.7,
)


def inside(system, count: int):
    """States in the box, ``(count, 6)``, in physical units, and forces ``(count,)`` in N."""
    draws = torch.rand(count, 7, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    return 0.8 * system.chart.length * draws[:, :6], 600.0 * draws[:, 6]


def derivative(system, s, force):
    a, B = system.dynamics(s)
    return a + B[..., 0] * force.unsqueeze(-1)


def lagrangian(system, q, v):
    """Of one state: a point mass at each centre and the inertia about it, by the velocities of the centres."""
    (l1, _), (r1, r2) = system.lengths, system.centres
    along = lambda tilt: torch.stack([tilt.sin(), tilt.cos()])
    places = lambda q: torch.cat([r1 * along(q[1]), l1 * along(q[1]) + r2 * along(q[2])])
    at, moved = torch.func.jvp(places, (q,), (v,))
    masses, inertias = (torch.tensor(each, dtype=torch.float64) for each in (system.masses, system.inertias))
    speeds = moved.reshape(2, 2) + torch.stack([v[0], torch.zeros_like(v[0])])
    kinetic = 0.5 * masses[0] * v[0] ** 2 + 0.5 * (masses[1:] * speeds.square().sum(-1) + inertias * v[1:] ** 2).sum()
    return kinetic - system.gravity * (masses[1:] * at[[1, 3]]).sum()


@pytest.mark.parametrize("system", [POLES, ODD])
def test_they_move_as_lagranges_equations_say(system):
    """`L_vv q'' = L_q - L_vq v - R_v + (F, 0, 0)`, with Rayleigh's `R` of the rail and of how the joints turn."""
    damping = torch.tensor(system.damping, dtype=torch.float64)
    rubbed = lambda v: 0.5 * (damping * torch.stack([v[0], v[1], v[2] - v[1]]).square()).sum()
    of = lambda q, v: lagrangian(system, q, v)
    states, forces = inside(system, 20)
    for s, force, rate in zip(states, forces, derivative(system, states, forces), strict=True):
        q, v = s[:3], s[3:]
        mixed = torch.func.jacrev(torch.func.grad(of, 1), 0)(q, v)
        torques = torch.func.grad(of, 0)(q, v) - mixed @ v - torch.func.grad(rubbed)(v)
        torques = torques + force * torch.eye(3, dtype=torch.float64)[0]
        expected = torch.linalg.solve(torch.func.hessian(of, 1)(q, v), torques)
        torch.testing.assert_close(rate, torch.cat([v, expected]), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("system", [POLES, ODD])
def test_the_energy_changes_by_what_the_force_does_and_what_is_rubbed_off(system):
    s, force = inside(system, 200)
    turning = torch.stack([s[:, 3], s[:, 4], s[:, 5] - s[:, 4]], dim=-1)
    power = force * s[:, 3] - (torch.tensor(system.damping, dtype=torch.float64) * turning.square()).sum(dim=-1)
    found = torch.func.jvp(system.energy, (s,), (derivative(system, s, force),))[1]
    torch.testing.assert_close(found, power, rtol=1e-8, atol=1e-8)


def test_energy_is_kept_along_paths_also_where_time_is_slowed_down():
    free = InvertedDoublePendulum(damping=[0.0] * 3)
    start = torch.tensor([[0.0, 0.2, 0.1, 0.3, 0.0, 0.0], [0.5, -0.3, 0.4, 0.0, 1.0, -1.0]], dtype=torch.float64)
    _, end = discounted_integral(lambda x: (free.drift(x), x[:, 0]), free.to_torus(start), 1.0, 2.0, 600)
    end = free.from_torus(end)
    assert bool(free.chart.outside(end).all())
    torch.testing.assert_close(free.energy(end), free.energy(start), rtol=0.0, atol=1e-6)


def test_with_an_upper_pole_of_no_mass_the_lower_one_is_that_of_the_cart_pole():
    cart = CartPole(cart_mass=0.9, pole_mass=0.4, half_length=0.35)
    poles = InvertedDoublePendulum(
        masses=[0.9, 0.4, 1e-12],
        lengths=[0.7, 0.5],
        centres=[0.35, 0.25],
        inertias=[0.4 * 0.7**2 / 12.0, 1e-13],
        damping=[0.0] * 3,
        gravity=cart.gravity,
    )
    s, force = inside(poles, 50)
    lower = [0, 1, 3, 4]
    torch.testing.assert_close(
        derivative(poles, s, force)[:, lower], derivative(cart, s[:, lower], force), rtol=1e-7, atol=1e-7
    )


def test_upright_is_a_state_of_rest_that_both_poles_fall_from():
    A = linearised(POLES, [0.0] * 6)[0]
    assert int((torch.linalg.eigvals(A).real > 1.0).sum()) == 2
    assert float(POLES.dynamics(torch.zeros(1, 6, dtype=torch.float64))[0].abs().max()) == 0.0
    s, force = inside(POLES, 50)
    torch.testing.assert_close(derivative(POLES, -s, -force), -derivative(POLES, s, force), **ROUNDING)
    torch.testing.assert_close(POLES.cost(-s), POLES.cost(s), **ROUNDING)


def test_wherever_the_tip_is_above_a_metre_no_pole_has_fallen():
    tilts = math.pi * (2.0 * torch.rand(5000, 2, generator=torch.Generator().manual_seed(1)).double() - 1.0)
    s = torch.cat([torch.zeros(5000, 1), tilts, torch.zeros(5000, 3)], dim=1).double()
    high = POLES.joints(s)[:, -1, 1] > 1.0
    assert 20 < int(high.sum())
    assert bool((tilts[high].abs() < POLES.max_tilt).all())


def test_what_its_environment_shows_is_the_state_and_its_action_the_force_over_500_newtons():
    p, t1, t2, v, w1, w2 = state = 0.3, 0.2, -0.4, 1.1, -2.0, 3.0
    joint = t2 - t1
    shown = [p, math.sin(t1), math.sin(joint), math.cos(t1), math.cos(joint), v, w1, w2 - w1, 0.0]
    assert POLES.observed(np.array(shown)) == pytest.approx(state)
    x = POLES.from_observation("InvertedDoublePendulum-v5", np.array(shown))
    u = POLES.to_controls(torch.tensor([[-250.0]]).double())[0].numpy()
    assert POLES.from_torus(torch.from_numpy(x)[None])[0].tolist() == pytest.approx(state)
    assert POLES.to_action("InvertedDoublePendulum-v5", u).tolist() == pytest.approx([-0.5])


@pytest.mark.nightly
def test_the_classical_controller_stands_and_without_one_they_fall():
    near = torch.tensor([[0.05, 0.05, 0.1, 0.0, 0.1, 0.0], [0.0, -0.1, 0.0, 0.1, 0.0, 0.2]], dtype=torch.float64)
    x = POLES.to_torus(near)
    best, none = {"success": 1.0, "upright": 1.0, "left": 0.0, "off_track": 0.0}, lambda x: torch.zeros_like(x[:, :1])
    assert measure(POLES, simulate(POLES, classical_policy(POLES), x, 8.0, 1600)) == best
    fallen = measure(POLES, simulate(POLES, none, x, 8.0, 1600))
    assert (fallen["success"], fallen["left"]) == (0.0, 1.0)
    away = POLES.to_torus(torch.tensor([[0.9, 0.0, 0.0, 2.0, 0.0, 0.0]], dtype=torch.float64))
    assert measure(POLES, simulate(POLES, none, away, 8.0, 1600))["off_track"] == 1.0


def test_the_force_is_paid_for_and_noise_lets_nobody_say_that_mu_is_unbounded():
    u = POLES.to_controls(torch.tensor([[300.0]]).double())
    assert float(POLES.control_cost.cost(u)) == pytest.approx(0.5 * POLES.force_weight * 300.0**2)
    s = torch.tensor([[0.3, 0.2, -0.1, 1.0, 2.0, -3.0]], dtype=torch.float64)
    expected = 2.0 - math.cos(0.2) - math.cos(0.1) + 0.5 * (0.2 * 0.09 + 0.02 * 1.0 + 0.02 * 13.0)
    assert float(POLES.state_cost(POLES.to_torus(s))) == pytest.approx(expected)
    assert POLES.occupation_bound == math.inf
    noisy = InvertedDoublePendulum(force_noise=5.0)
    assert noisy.occupation_bound is None
    torch.testing.assert_close(noisy.disturbance(s), 5.0 * noisy.dynamics(s)[1])


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        (dict(masses=[1.0, 1.0]), "problem.masses is .* a list of 3 numbers"),
        (dict(lengths=[0.6, -0.6]), r"problem.lengths\[1\] is -0.6, but must be .*above 0"),
        (dict(inertias=[0.0, 0.1]), r"problem.inertias\[0\] is 0, but must be .*above 0"),
        (dict(damping=[0.0, -1.0, 0.0]), r"problem.damping\[1\] is -1, but must be at least 0"),
        (dict(max_tilt=0.0), "problem.max_tilt is 0, but must be above 0"),
        (dict(force_weight=0.0), "problem.force_weight is 0, but must be above 0"),
        (dict(start={"tilt": [0, 1]}), "start names 'tilt', but must name coordinates: position, lower tilt"),
    ],
)
def test_wrong_arguments_get_one_sentence(wrong, sentence):
    with pytest.raises(InputError, match=sentence):
        InvertedDoublePendulum(**wrong)
