"""The density along paths that are followed back in time, with noise: against its equation and the law of the paths."""

import pytest
import torch

from ocp_torch.certificate.simulated.trajectories import _noisy_piece, backward_flow
from ocp_torch.maths.differences import STEPS
from ocp_torch.problems import Problem
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo


@zoo.on(("noisy 1-d", "noisy 2-d sigma(x)"))
def test_the_flow_and_the_growth_are_those_of_the_adjoint_equation(problem):
    """`rho mu = rho mu0 + D : hess mu + drift . grad mu + growth mu` for `mu*`, with the drift and the growth of the flow."""
    x = zoo.states(problem, 40, seed=8)
    L = Generator.of(problem, Samples.of(problem, x))
    mu = L.jet(problem.exact_occupation)
    motion, rate = backward_flow(problem, problem.exact_control)(torch.cat([x, torch.zeros_like(x[:, :1])], dim=-1))
    carried = mu.curvature + (motion[:, :-1] * mu.gradient).sum(dim=-1) + motion[:, -1] * mu.value
    torch.testing.assert_close(rate, problem.initial_density(x))
    accuracy = 1e3 * STEPS[torch.float64]  # the divergence of the closed loop is a difference quotient
    expected = problem.discount * (mu.value - rate)
    torch.testing.assert_close(carried, expected, rtol=accuracy, atol=accuracy * problem.discount)


@pytest.mark.parametrize("nu", [0.0, 0.02])
def test_paths_spread_as_their_noise_says_and_differently_in_each_piece(nu):
    problem, horizon, count = Problem(2, noise=[0.05, nu]), 1.5, 4000
    rest = lambda x: torch.zeros_like(x)
    start = torch.zeros(count, 3, dtype=torch.float64)
    ends = [_noisy_piece(problem, backward_flow(problem, rest), start, horizon, 20, k)[1] for k in (0, 1)]
    for end in ends:
        assert float(end[:, 0].var()) == pytest.approx(2.0 * 0.05 * horizon, rel=0.1)
        assert float(end[:, 1].var()) == pytest.approx(2.0 * nu * horizon, rel=0.1)
        assert not end[:, 2].any()
    assert abs(float(torch.corrcoef(torch.stack([end[:, 0] for end in ends]))[0, 1])) < 0.08
