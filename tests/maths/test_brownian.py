"""Paths with noise: nested grids show the same path, means converge in weak order, and intervals cover closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from ocp_torch.maths.brownian import Grid, Multilevel, discounted, increments, path_integral

# An Ornstein-Uhlenbeck process `dx = -RATE x dt + SPREAD dW` from START, its cost x^2 discounted at RHO.
RATE, SPREAD, START, RHO, HORIZON = 1.3, 0.5, 0.7, 2.0, 8.0
STATIONARY = SPREAD**2 / (2.0 * RATE)
EXACT = RHO * ((START**2 - STATIONARY) / (RHO + 2.0 * RATE) + STATIONARY / RHO)


def dynamics(x):
    return -RATE * x, x[:, 0].square()


def constant(x):
    return torch.full((len(x), 1, 1), SPREAD, dtype=x.dtype)


def equal(count, steps, grading=1.0):
    return Grid(torch.full((count,), HORIZON, dtype=torch.float64), steps, grading)


@pytest.mark.parametrize("grading", [1.0, 2.0])
def test_halved_steps_follow_the_same_paths(grading):
    grid = equal(7, 6, grading)
    coarse, fine = increments(grid, 3, 0, seed=1, rows=0), increments(grid, 3, 2, seed=1, rows=0)
    torch.testing.assert_close(fine.unflatten(0, (6, 4)).sum(dim=1), coarse)
    assert not torch.equal(increments(grid, 3, 0, seed=1, rows=1), coarse)


def test_increments_are_independent_and_as_large_as_their_time():
    grid = Grid(torch.tensor([1.0, 4.0], dtype=torch.float64).repeat_interleave(20_000), 3, 2.0)
    moves = increments(grid, 1, 1, seed=3, rows=0)[..., 0]  # (6, 40000)
    for rows, horizon in ((slice(0, 20_000), 1.0), (slice(20_000, None), 4.0)):
        covariance = torch.cov(moves[:, rows])
        expected = torch.diag(replace(grid, steps=2 * grid.steps).parts.diff() * horizon)
        torch.testing.assert_close(covariance, expected, rtol=0.05, atol=0.02 * horizon)


def test_the_mean_is_of_weak_order_one_and_two_once_it_is_extrapolated():
    """Errors of means of one million paths on 4, 8 and 16 steps, from the closed form of the scheme's own moments."""
    errors = []
    for steps in (8, 16, 32):
        grid = equal(1, steps)
        # Euler-Maruyama moments of the linear process: exact means, no sampling.
        h, second, total = HORIZON / steps, START**2, 0.0
        for k in range(steps + 1):
            weight = h * (0.5 if k in (0, steps) else 1.0) * RHO * math.exp(-RHO * k * h)
            total += weight * second
            second = (1.0 - RATE * h) ** 2 * second + SPREAD**2 * h
        errors.append(total)
        mean = torch.stack(
            [
                path_integral(
                    dynamics,
                    constant,
                    torch.full((4096, 1), START, dtype=torch.float64),
                    equal(4096, steps),
                    increments(equal(4096, steps), 1, 0, seed=s, rows=0),
                    discounted(RHO),
                )[0]
                for s in range(4)
            ]
        )
        assert abs(float(mean.mean()) - total) <= 4.0 * float(mean.std()) / 128.0
        assert grid.steps == steps
    exact = EXACT
    plain = [abs(e - exact) for e in errors]
    extrapolated = [abs(2.0 * b - a - exact) for a, b in zip(errors, errors[1:], strict=False)]
    assert plain[1] / plain[2] > 1.7
    assert extrapolated[0] / extrapolated[1] > 3.0


REPLICATES, PATHS = 8, 128


def mean(dynamics, noise, x0, grid, weight, tolerance, seed):
    """The mean of all paths, its standard error and the bound on its bias."""
    found = Multilevel(dynamics, noise, x0, torch.ones(len(x0)).double(), REPLICATES, grid, weight, seed).mean(
        tolerance
    )
    totals = found.integrals.view(REPLICATES, -1).mean(dim=1) + found.refinement
    return float(totals.mean()), float(totals.std()) / math.sqrt(REPLICATES), found.bias


def test_intervals_cover_an_ornstein_uhlenbeck_process():
    """At most 3 of 20 intervals of Student's t at 95 % and the bias may miss: 1 is expected."""
    missed = 0
    start = torch.full((REPLICATES * PATHS, 1), START, dtype=torch.float64)
    for seed in range(20):
        value, error, bias = mean(dynamics, constant, start, equal(len(start), 16, 2.0), discounted(RHO), 1e-6, seed)
        missed += abs(value - EXACT) > 2.365 * error + bias
        assert bias < 2.0 * error
    assert missed <= 3


def test_refinement_takes_away_the_error_of_the_first_steps():
    """On 4 steps the mean is off by far more than its interval; halved and extrapolated it is within."""
    start = torch.full((REPLICATES * 1024, 1), START, dtype=torch.float64)
    ones, grid = torch.ones(len(start)).double(), equal(len(start), 8)
    found = Multilevel(dynamics, constant, start, ones, REPLICATES, grid, discounted(RHO), 3).mean(1e-6)
    value, error, bias = mean(dynamics, constant, start, equal(len(start), 8), discounted(RHO), 1e-6, 3)
    assert abs(float(found.integrals.mean()) - EXACT) > 5.0 * (2.365 * error + bias)
    assert abs(value - EXACT) <= 2.365 * error + bias


def test_intervals_cover_a_process_whose_drift_jumps():
    """`dx = -sign(x) dt + sigma dW` with the cost `|x|`: `V = |x| - 1 / rho + e^{-s |x|} / s` with `nu s^2 + s = rho`, which
    is differentiable at 0. At most 3 of 20 intervals may miss: the weak order is lower here."""
    nu, x0, missed = 0.5 * SPREAD**2, 0.2, 0
    s = (math.sqrt(1.0 + 4.0 * nu * RHO) - 1.0) / (2.0 * nu)
    exact = x0 - 1.0 / RHO + math.exp(-s * x0) / s
    start = torch.full((REPLICATES * PATHS, 1), x0, dtype=torch.float64)
    for seed in range(20):
        grid = equal(len(start), 8, 2.0)
        value, error, bias = mean(
            lambda x: (-x.sign(), x[:, 0].abs()), constant, start, grid, discounted(RHO), 1e-6, seed
        )
        missed += abs(value - exact) > 2.365 * error + bias
        assert bias < 5.0 * error
    assert missed <= 3
