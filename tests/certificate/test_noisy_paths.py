"""Paths with noise: the density by following them back, against its equation and their law; and what is averaged on them."""

from dataclasses import replace

import pytest
import torch

from ocp_torch.certificate.simulated import candidates
from ocp_torch.certificate.simulated.backward import _noisy_piece, backward_flow
from ocp_torch.certificate.simulated.candidates import Candidate, first_look, simulate_candidates
from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.maths.differences import STEPS
from ocp_torch.problems import Manufactured, Problem
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.training.evaluator import QUICK
from support import zoo


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("noise", "efforts"), [(0.02, [4, 4, 16, 4]), pytest.param(0.0, [16, 16, 4], marks=pytest.mark.nightly)]
)
def test_with_noise_a_controller_that_is_clearly_worse_is_followed_shortly_even_in_a_quick_look(
    noise, efforts, monkeypatch
):
    """Without, so few trajectories are no work. The last ones are those of doing nothing."""
    problem, made = Manufactured(dim=1, noise=noise), []

    def simulated(problem, policy, **how):
        made.append(how["trajectories"])
        return Simulation(problem, policy, **how)

    monkeypatch.setattr(candidates, "Simulation", simulated)
    wild = lambda x: torch.full_like(x, 30.0)
    both = {"worse": Candidate(wild, None, None), "good": Candidate(problem.exact_control, None, None)}
    settings = replace(QUICK, tolerance=0.05)
    looked = first_look(problem, both, settings, 0, best_only=True)
    found, _ = simulate_candidates(problem, both, settings, 0, looked)
    assert made == efforts
    assert found["worse"].perf.value > 2.0 * found["good"].perf.value


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


@pytest.mark.nightly
@pytest.mark.usefixtures("any_variate")
def test_what_is_simulated_beside_a_control_variate_has_its_curvature():
    """With `V* + s mu*` the curvature is `s E[mu* D : hess mu*] / rho` of the answer, far more than simulation is off."""
    problem = Manufactured(dim=1, noise=0.4)
    size, side = 0.3 * problem.exact_optimum, torch.arange(64, dtype=torch.float64) / 64
    value = lambda x: problem.exact_value(x) + size * problem.exact_occupation(x)
    x = torch.cartesian_prod(*[side] * problem.dim).reshape(-1, problem.dim)
    bent = Generator.of(problem, Samples.of(problem, x)).jet(value).curvature
    curvature = float((problem.exact_occupation(x) * bent).mean().detach()) / problem.discount
    initial = [float((value(x) * problem.initial_density(x)).mean())] * 4
    found = Simulation(problem, problem.exact_control, 1024, 4, 0, value=value, initial=initial, tolerance=3e-2).run()
    low, high = found.perf.interval(0.999)
    assert low <= problem.exact_optimum <= high
    assert abs(found.perf.value - problem.exact_optimum) < 0.15 * abs(curvature)
