"""What a fit of a density is judged by: the excess of its bound, for the best multiples of `mu` and `V`, spikes included."""

import math

import pytest
import torch

from ocp_torch.certificate.lower.slack import Scaled, slack_function, slack_peaks
from ocp_torch.certificate.upper.excess import Excess
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.certificate.upper.policy_evaluation import positive_weight
from ocp_torch.problems import Manufactured
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo

PEAKS, CLIMBED = 16, 20


@pytest.fixture
def optimal():
    """A smooth problem, and the closed loop of its optimal controller with samples of it."""
    problem = zoo.build("manufactured 2-d q=2")
    loop = ClosedLoop(problem, problem.exact_control)
    return problem, loop, Samples.of(loop, zoo.states(problem, 4000))


def spike(at: float, width: float, height: float):
    """A bump of the torus in two dimensions."""
    distance = lambda x: (torch.sin(math.pi * (x - at)) ** 2).sum(dim=-1) / (math.pi * width) ** 2
    return lambda x: height * torch.exp(-distance(x))


@pytest.mark.parametrize("ascents", [False, True])
def test_the_excess_is_what_the_bound_adds_to_its_integral(ascents, optimal):
    _, loop, samples = optimal
    value, log_mu = (zoo.rough_network(2, seed, size=0.1) for seed in (1, 2))
    shifted = lambda x: 1.0 + value(x)
    found, theta = Excess(loop, shifted, samples, ascents).of(log_mu)
    bound = closed_loop_bounds(loop, Scaled(shifted, theta), log_mu, [samples, samples], 1, "value").lagrangian.value
    generator = Generator.of(loop, samples)
    V = generator.jet(shifted)
    v, slack = V.value.detach(), generator.hjb_slack(V).detach()
    mu = log_mu(samples.x).exp().detach()
    without = float((v * samples.mu0 - mu * slack).mean())
    excess = found * float((v * samples.mu0).mean())
    assert without + excess == pytest.approx(bound, rel=2e-2)
    if not ascents:  # the bound's suprema are climbed
        assert without + excess <= bound + 1e-12


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.2])
def test_the_multiple_of_v_is_found_that_makes_it_the_value_of_the_controller(factor, optimal):
    problem, loop, samples = optimal
    value, log_mu = lambda x: problem.exact_value(x) / factor, zoo.rough_network(2, 3, size=0.1)
    _, theta = Excess(loop, value, samples).of(log_mu)
    assert theta == pytest.approx(factor, abs=1e-4)
    bound = lambda V: closed_loop_bounds(loop, V, log_mu, [samples] * 2, 1, "value").lagrangian.value
    exact = float((problem.exact_value(samples.x) * samples.mu0).mean())
    assert bound(Scaled(value, theta)) == pytest.approx(exact, rel=1e-4)
    assert factor == 1.0 or bound(value) > 1.001 * exact


def test_a_spike_between_the_samples_counts(optimal):
    problem, loop, samples = optimal
    narrow = spike(0.5, 0.01, 0.01)
    value = lambda x: problem.exact_value(x) + narrow(x)
    off = samples.take((narrow(samples.x) < 1e-3).nonzero().squeeze(-1))
    log_mu = zoo.rough_network(2, 3, size=0.1)
    sampled, climbed = (Excess(loop, value, off, ascents) for ascents in (False, True))
    assert max(climbed.suprema()) > 3.0 * max(sampled.suprema())
    assert climbed.of(log_mu)[0] > 3.0 * sampled.of(log_mu)[0]


def test_the_weight_of_missing_mass_follows_the_slack(optimal):
    """Deep slack on one side makes that side of the residual weigh more, within limits; a sign turned turns the ratio."""
    problem, loop, samples = optimal
    low, high = ((lambda x, c=c: problem.exact_value(x) + c) for c in (-0.1, 0.1))
    assert positive_weight(*Excess(loop, low, samples).suprema()) == pytest.approx(4.0)
    assert positive_weight(*Excess(loop, high, samples).suprema()) == pytest.approx(0.25)
    assert positive_weight(0.0, 0.0) == 1.0


def test_peaks_of_the_slack_are_of_both_signs():
    problem = Manufactured(dim=2)
    value = lambda x: problem.exact_value(x) + 0.01 * torch.sin(2.0 * math.pi * x[:, 0])
    x = torch.rand(2048, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    found, largest = slack_peaks(problem, value, x, PEAKS, CLIMBED)
    slack = lambda at: slack_function(problem, value)(at).detach()
    assert found.shape == (2 * PEAKS, 2)
    assert bool((slack(found[:PEAKS]) >= slack(x).topk(PEAKS).values - 1e-12).all())
    assert bool((slack(found[PEAKS:]) <= -(-slack(x)).topk(PEAKS).values + 1e-12).all())
    assert largest == pytest.approx(float(slack(found).abs().max()), rel=1e-9)
