"""States of rest: found where they are known, with the value near them that linear theory and a simulation give."""

import math

import numpy as np
import pytest
import torch

from ocp_torch.problems import PROBLEMS, Simulator
from ocp_torch.problems.equilibrium import equilibrium
from support.zoo import Swing

RESTS = {
    "pendulum": (0.0, 0.0),
    "cart_pole": (0.0,) * 4,
    "inverted_double_pendulum": (0.0,) * 6,
    "acrobot": (0.0,) * 4,
    "pendubot": (0.0,) * 4,
    "quadrotor": (0.0, 1.5, 0.0, 0.0, 0.0, 0.0),
    "satellite": (0.0,) * 6,
    "double_integrator": (0.0, 0.0),
    "phase_locked_loop": (0.0, 0.0),
}


@pytest.mark.parametrize("name", RESTS)
def test_a_system_comes_to_rest_where_it_costs_nothing(name):
    problem = PROBLEMS[name]()
    found = equilibrium(problem)
    off = (found.at - problem.to_torus(torch.tensor([RESTS[name]], dtype=torch.float64))[0] + 0.5).remainder(1.0) - 0.5
    assert float(off.abs().max()) < 1e-7
    assert float(torch.linalg.eigvalsh(found.bend).min()) > 0.0
    assert equilibrium(problem) is found
    if not problem.noisy:
        assert found.gathers == (problem.occupation_bound == math.inf)


def test_the_value_near_it_is_that_of_the_riccati_equation():
    problem = PROBLEMS["double_integrator"]()
    lengths = problem.chart.length.double()
    expected = problem.discount * problem.plane.P * lengths * lengths.unsqueeze(-1)
    found = equilibrium(problem)
    torch.testing.assert_close(found.bend, expected, rtol=1e-5, atol=1e-6)
    assert found.gathers == (problem.plane.contraction >= problem.discount)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["cart_pole", pytest.param("pendubot", marks=pytest.mark.nightly)])
def test_the_linear_controller_costs_what_it_says(name):
    problem = PROBLEMS[name]()
    at, bend, _ = equilibrium(problem)
    B, rho = problem.control_matrix(at.unsqueeze(0))[0], problem.discount
    y = 1e-4 * torch.randn(8, problem.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    h, cost, x = 4e-3, torch.zeros(8, dtype=torch.float64), at + y
    control = lambda x: -(x - at) @ (bend / rho) @ B
    for k in range(round(8.0 / h)):
        u = control(x)
        middle = x + 0.5 * h * problem.velocity(x, u)
        u = control(middle)
        cost += h * rho * math.exp(-rho * (k + 0.5) * h) * (problem.state_cost(middle) + 0.5 * u.square().sum(dim=-1))
        x = x + h * problem.velocity(middle, u)
    torch.testing.assert_close(cost, 0.5 * torch.einsum("ni,ij,nj->n", y, bend, y), rtol=0.01, atol=0.0)


@pytest.mark.parametrize(
    "problem", [PROBLEMS["dubins"](), PROBLEMS["kuramoto"](), Swing()], ids=lambda p: type(p).__name__
)
def test_what_never_rests_has_none(problem):
    assert equilibrium(problem) is None


def test_a_cost_that_is_flat_or_unstable_where_nobody_can_help_has_none_or_a_finite_one():
    class Flat(Swing):
        def state_cost(self, x):
            return torch.ones_like(x[:, 0])

    class Helpless(Swing):
        def drift(self, x):
            return (2.0 * math.pi * x).sin()

        def control_matrix(self, x):
            return x.new_zeros(len(x), 2, 1)

    class Steep(Swing):
        def state_cost(self, x):
            return 1e308 * (math.pi * x).sin().square().sum(dim=-1)

    for problem in (Flat(), Steep()):
        found = equilibrium(problem)
        assert found is None or bool(found.bend.isfinite().all())
    assert equilibrium(Helpless()) is None
    assert equilibrium(PROBLEMS["torus"](dim=65)) is None


def test_a_simulator_is_not_asked():
    asked = []

    def oracle(x):
        asked.append(x)
        return (np.sin(np.pi * x) ** 2).sum(axis=-1), None, np.broadcast_to(np.eye(2), (len(x), 2, 2))

    problem = Simulator(oracle, dim=2)
    asked.clear()
    assert equilibrium(problem) is None
    assert asked == []
