"""Values on a grid: interpolation, the fixed point, and exact value functions with a limit on the control, noise included."""

import math

import pytest
import torch

from ocp_torch.control.pace import Pace
from ocp_torch.problems import PROBLEMS
from ocp_torch.training.warm_start.grid import CONTROLS, SIDE, GridValues, slopes, solved, stencil
from support.zoo import fresh


def off(problem, part: float = 1.0) -> float:
    """By what part of the exact value's spread the grid's is off, for steps of a ``part`` of the usual."""
    pace = Pace.of(problem)
    source = GridValues(problem, pace.with_step(part * pace.step), torch.zeros(1, dtype=torch.float64))
    x, V, *_ = source.targets(lambda x: x)
    exact = problem.exact_value(x)
    return float((V - exact).square().mean().sqrt() / exact.std())


def test_a_stencil_interpolates_what_is_bilinear_and_wraps():
    nodes = torch.cartesian_prod(*[torch.arange(SIDE, dtype=torch.float64) / SIDE] * 2)
    points = torch.rand(2, 50, 2, dtype=torch.float64) * (SIDE - 1) / SIDE  # the last cell leads back to the first node
    of = lambda x: 1.0 + 2.0 * x[..., 0] - 3.0 * x[..., 1] + 5.0 * x[..., 0] * x[..., 1]
    index, weight = stencil(points + torch.tensor([2.0, -1.0]))
    torch.testing.assert_close((weight * of(nodes)[index]).sum(dim=-1), of(points).mean(dim=0))
    index, weight = stencil(torch.full((1, 1, 2), 1.0 - 0.25 / SIDE, dtype=torch.float64))
    assert float(weight[index == 0].sum()) == pytest.approx(0.75**2)


def test_slopes_are_derivatives_that_wrap():
    x = torch.cartesian_prod(*[torch.arange(SIDE, dtype=torch.float64) / SIDE] * 2)
    a, b = (2.0 * math.pi * x).unbind(-1)
    exact = 2.0 * math.pi * torch.stack([a.cos() * b.cos(), -a.sin() * b.sin()], dim=-1)
    torch.testing.assert_close(slopes(a.sin() * b.cos()), exact, rtol=0.0, atol=2e-3)


def test_the_fixed_point_is_that_of_plain_value_iteration():
    generator = torch.Generator().manual_seed(0)
    index = torch.randint(40, (3, 40, 2), generator=generator)
    weight = torch.rand(3, 40, 2, generator=generator).double()
    weight = 0.9 * weight / weight.sum(dim=-1, keepdim=True)
    cost = torch.rand(3, 40, generator=generator).double()
    V = torch.zeros(40, dtype=torch.float64)
    for _ in range(400):
        V = (cost + (weight * V[index]).sum(dim=-1)).amin(dim=0)
    torch.testing.assert_close(solved(index, weight, cost, 0.1), V, rtol=0.002, atol=0.0)


LIMITED = dict(dim=2, control_dim=1, control_limit=0.6, discount=1.5, seed=3)


@pytest.mark.nightly
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_it_is_near_the_exact_value_where_that_is_known(noise):
    problem = PROBLEMS["manufactured"](**LIMITED, noise=noise)
    assert GridValues.suits(problem)
    assert off(problem) < 0.03


@pytest.mark.nightly
def test_with_noise_that_varies_the_error_is_of_first_order_in_the_step():
    problem = PROBLEMS["manufactured"](**LIMITED, noise=0.02, state_dependent_noise=True)
    whole, half = off(problem), off(problem, 0.5)
    assert half < 0.6 * whole < 0.06


def test_it_is_for_two_coordinates_and_one_limited_control():
    for name, arguments, suits in [
        ("pendulum", {"control_limit": 1.0}, True),
        ("pendulum", {}, False),
        ("cart_pole", {}, False),
        ("manufactured", {"control_limit": 0.5}, False),
    ]:
        assert GridValues.suits(PROBLEMS[name](**arguments)) == suits
    assert not GridValues.suits(fresh("circle rho=2"))


@pytest.mark.nightly
def test_states_are_counted_once():
    source = GridValues(PROBLEMS["manufactured"](**LIMITED), Pace(0.02, 1), torch.zeros(1))
    found = source.targets(lambda x: x)
    assert source.drawn == CONTROLS * SIDE**2
    assert source.targets(lambda x: x) is found
    assert source.drawn == 0
    assert math.isfinite(float(found.y.sum()))
