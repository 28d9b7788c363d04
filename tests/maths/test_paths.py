"""Weights along paths with noise, and that no two groups of paths share their noise."""

import math

import pytest
import torch

from ocp_torch.maths.brownian import DRAWN_TOGETHER, Grid, Multilevel, at_random_times, discounted, path_integral

RHO = 2.0


def test_at_random_times_a_constant_rate_counts_once_in_the_mean():
    """`E int weight ds = 1` for `T ~ Exp(rho)`, by its quantiles; with times that are fixed `1 - e^{-rho T}`."""
    count, steps = 200_000, 64
    times = -torch.log1p(-(torch.arange(count, dtype=torch.float64) + 0.5) / count) / RHO
    total = lambda weight: sum(weight(times, (k + 0.5) / steps) for k in range(steps)) / steps
    assert float(total(at_random_times(RHO)).mean()) == pytest.approx(1.0, rel=2e-3)
    torch.testing.assert_close(total(discounted(RHO)), 1.0 - torch.exp(-RHO * times), rtol=1e-2, atol=1e-3)


def test_groups_of_paths_from_one_start_are_independent():
    count = 2 * DRAWN_TOGETHER
    x0, weights = torch.zeros(count, 1, dtype=torch.float64), torch.ones(count, dtype=torch.float64)
    grid = Grid(torch.ones(count, dtype=torch.float64), 4, 1.0)
    noise = lambda x: torch.ones(len(x), 1, 1, dtype=x.dtype)
    dynamics = lambda x: (0.0 * x, x[:, 0])
    run = lambda seed: Multilevel(dynamics, noise, x0, weights, 1, grid, discounted(RHO), seed).mean(1.0)
    result, _, end, *_ = run(0)
    for values in (result, end[:, 0]):
        first, second = values[:DRAWN_TOGETHER], values[DRAWN_TOGETHER:]
        assert abs(float(torch.corrcoef(torch.stack([first, second]))[0, 1])) < 5.0 / math.sqrt(DRAWN_TOGETHER)
    assert float(end.square().mean()) == pytest.approx(1.0, rel=0.2)
    assert not torch.equal(run(1).end, end)


@pytest.mark.parametrize("steps", [64, 128])
def test_means_are_extrapolated_and_the_bias_covers_what_is_left(steps):
    """Where noise is 0 the scheme is Euler's: half of its error is left on half the step, and far less extrapolated."""
    rate, start, horizon = 1.3, 0.7, 4.0
    exact = RHO * start**2 / (RHO + 2.0 * rate) * (1.0 - math.exp(-(RHO + 2.0 * rate) * horizon))
    x0, weights = torch.full((3, 1), start, dtype=torch.float64), torch.ones(3, dtype=torch.float64)
    grid = Grid(torch.full((3,), horizon, dtype=torch.float64), steps, 1.0)
    still, dynamics = lambda x: torch.zeros(len(x), 1, 1, dtype=x.dtype), lambda x: (-rate * x, x[:, 0].square())
    finest = Grid(grid.horizon, 4 * steps, 1.0)
    moves = torch.zeros(4 * steps, 3, 1, dtype=torch.float64)
    plain = float(path_integral(dynamics, still, x0, finest, moves, discounted(RHO))[0].mean()) - exact
    found = Multilevel(dynamics, still, x0, weights, 3, grid, discounted(RHO), 0).mean(math.inf)
    error, bias = float(found.integrals.mean() + found.refinement.mean()) - exact, found.bias
    assert abs(error) < 0.3 * abs(plain)
    assert abs(error) <= bias < 8.0 * abs(plain)
