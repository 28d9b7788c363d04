"""The slack of functions of `V` along a closed loop: the best of them, spikes, and what a fit of a density is judged by."""

import math

import pytest
import torch

from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.certificate.upper.lowered import UNCHANGED, Above, LoweredSlack, Lowering, SampledSlack
from ocp_torch.certificate.upper.multiples import terms_on
from ocp_torch.certificate.upper.policy_evaluation import positive_weight
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.maths.jets import reverse_jet
from ocp_torch.maths.supremum import extremes, value_and_gradient
from ocp_torch.problems import Manufactured
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo
from support.hidden_peak import HILLS, Still, hidden_peak, top

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


def judged(loop, value, samples, log_mu):
    """The slack of ``value``, and the terms it is judged with."""
    return LoweredSlack(loop, value, samples), terms_on(Generator.of(loop, samples), value, log_mu)[0]


def lagrangian(loop, value, log_mu, samples, ascents=1):
    return closed_loop_bounds(loop, value, log_mu, [samples, samples], ascents, "value")


@pytest.mark.nightly
def test_the_excess_is_what_the_bound_adds_to_its_integral(optimal):
    _, loop, samples = optimal
    value, log_mu = (zoo.rough_network(2, seed, size=0.1) for seed in (1, 2))
    slack, terms = judged(loop, lambda x: 1.0 + value(x), samples, log_mu)
    bound = lagrangian(loop, slack.value, log_mu, samples).lagrangian.value
    without = float((terms.v * samples.mu0 - terms.spent).mean())
    met = without + slack.excess(terms) * float((terms.v * samples.mu0).mean())
    assert met <= bound + 1e-9  # the bound's suprema are climbed
    assert met == pytest.approx(bound, rel=2e-2)


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.2])
def test_the_multiple_of_v_is_found_that_makes_it_the_value_of_the_controller(factor, optimal):
    problem, loop, samples = optimal
    found = lagrangian(loop, lambda x: problem.exact_value(x) / factor, zoo.rough_network(2, 3, size=0.1), samples)
    assert found.how.above == Above()
    assert 1.0 - found.how.by == pytest.approx(factor, abs=1e-4)
    exact = float((problem.exact_value(samples.x) * samples.mu0).mean())
    for bound in (found.lagrangian, found.below, *found.sandwich):
        assert bound.value == pytest.approx(exact, rel=2e-4)


@pytest.mark.nightly
def test_the_bounds_of_another_multiple_of_v_and_with_more_states_for_its_mean_are_the_same(optimal):
    problem, loop, samples = optimal
    log_mu, rough = zoo.rough_network(2, 3, size=0.1), zoo.rough_network(2, 4, size=0.02)
    bounds = []
    for factor in (1.0, 0.8):
        value = lambda x, factor=factor: factor * (problem.exact_value(x) + rough(x))
        initial = [float((value(samples.x) * samples.mu0).mean())] * 2
        bounds.append(closed_loop_bounds(loop, value, log_mu, [samples] * 2, 4, "value", initial))
    one, other = bounds
    more = closed_loop_bounds(loop, value, log_mu, [samples] * 2, 4, "value", [e + 0.01 for e in initial])
    for name in ("lagrangian", "J", "below"):
        assert getattr(one, name).value == pytest.approx(getattr(other, name).value, rel=1e-3)
        assert getattr(more, name).value == pytest.approx(getattr(other, name).value + 0.01, rel=1e-9)


@pytest.mark.parametrize("name", ["manufactured 2-d q=2", "noisy 2-d sigma(x)"])
@pytest.mark.parametrize("whole", [True, False])
def test_slack_and_derivatives_of_a_function_of_v_are_those_of_that_function(whole, name):
    problem = zoo.build(name)
    loop, V = ClosedLoop(problem, problem.exact_control), zoo.rough_network(2, 3)
    samples = Samples.of(loop, zoo.states(problem, 500))
    low, high = (float(V(samples.x).quantile(part)) for part in (0.3, 0.7))  # states below, on the bend and above
    how = Lowering(Above() if whole else Above(low, high - low), 0.3)
    L = Generator.of(loop, samples)
    by_hand, own = reverse_jet(lambda x: how(V(x)), samples.x, samples.noise), how.jet(L.jet(V), samples.noise)
    for part in ("value", "gradient", "curvature"):
        torch.testing.assert_close(getattr(own, part), getattr(by_hand, part), rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(SampledSlack.at(L, V).of(how), L.hjb_slack(by_hand), rtol=1e-9, atol=1e-9)
    assert bool((how(V(samples.x).sort().values).diff() >= 0.0).all())  # as C_V takes for granted


@pytest.mark.parametrize("name", ["manufactured 2-d q=2", "noisy 2-d sigma(x)"])
def test_of_the_controller_of_v_one_jet_gives_the_slack(name):
    problem, x = zoo.build(name), torch.rand(50, 2, dtype=torch.float64)
    V, how = zoo.rough_network(2, 3), Lowering(by=0.1)
    found = []
    for policy in (
        ValuePolicy(problem, V),
        lambda at: ValuePolicy(problem, V)(at),
    ):  # the second does not say whose it is
        loop = ClosedLoop(problem, policy)
        slack = LoweredSlack(loop, V, Samples.of(loop, x))._slack_of(how, V)
        found.append(torch.stack([slack(x), *value_and_gradient(slack, x)[1].T]))
    torch.testing.assert_close(*found, rtol=1e-10, atol=1e-10)


def test_what_is_too_large_at_the_top_alone_is_taken_off_there(optimal):
    """As beside kinks that cross: a multiple would pay below for what is wrong above."""
    problem, loop, samples = optimal
    exact = problem.exact_value
    high = Above(float(exact(samples.x).quantile(0.9)), 0.02)
    value = lambda x: exact(x) + 0.5 * high(exact(x))[0]
    slack, terms = judged(loop, value, samples, zoo.rough_network(2, 3, size=0.3))
    whole, how = slack.lowest(terms)
    slack.choices = [Above()]
    multiples, multiple = slack.lowest(terms)
    slack.choices = []
    plain, unchanged = slack.lowest(terms)
    assert unchanged == UNCHANGED
    assert how.above.height > float(exact(samples.x).median())
    assert multiple.by > 0.0
    truth = float((exact(samples.x) * samples.mu0).mean())
    assert truth - 1e-4 < whole < truth + 0.9 * (multiples - truth)
    assert multiples < plain


def test_a_spike_between_the_samples_counts_once_ascents_have_ended_on_it(optimal):
    problem, loop, samples = optimal
    narrow = spike(0.5, 0.01, 0.01)
    value = lambda x: problem.exact_value(x) + narrow(x)
    off = samples.take((narrow(samples.x) < 1e-3).nonzero().squeeze(-1))
    slack, terms = judged(loop, value, off, zoo.rough_network(2, 3, size=0.1))
    sampled, excess = max(slack.suprema()), slack.excess(terms)
    slack.climb(UNCHANGED, 32, 40)
    assert max(e.value for e in slack.extrema(UNCHANGED, 32)) == max(slack.suprema()) > 3.0 * sampled
    assert slack.excess(terms) > 3.0 * excess
    assert max(slack.suprema(Lowering(by=0.001))) > 3.0 * sampled  # and stays known where another multiple is tried


def test_a_spike_that_all_sampled_states_miss_is_met_at_an_odd_state_on_it(optimal):
    problem, loop, samples = optimal
    narrow = spike(0.5, 1e-4, 0.05)
    value = lambda x: problem.exact_value(x) + narrow(x)
    largest = lambda odd: max(LoweredSlack(loop, value, samples, odd).suprema())
    on_it = torch.full((1, 2), 0.5, dtype=torch.float64)
    assert largest(None) < 1e-6
    assert largest(on_it) == pytest.approx(0.05, rel=1e-3)
    log_mu = zoo.rough_network(2, 3, size=0.1)
    bounds = lambda odd: closed_loop_bounds(loop, value, log_mu, [samples] * 2, 1, "value", odd=odd)
    without, found = bounds(None), bounds(on_it)
    assert without.eps_lo.value + without.eps_hi.value < 1e-6
    assert found.eps_lo.value + found.eps_hi.value > 0.04


def test_the_weight_of_missing_mass_follows_the_slack(optimal):
    """Deep slack on one side makes that side of the residual weigh more, within limits; a sign turned turns the ratio."""
    problem, loop, samples = optimal
    low, high = ((lambda x, c=c: problem.exact_value(x) + c) for c in (-0.1, 0.1))
    assert positive_weight(*LoweredSlack(loop, low, samples).suprema()) == pytest.approx(4.0)
    assert positive_weight(*LoweredSlack(loop, high, samples).suprema()) == pytest.approx(0.25)
    assert positive_weight(0.0, 0.0) == 1.0


def test_peaks_of_the_slack_are_of_both_signs():
    problem = Manufactured(dim=2)
    value = lambda x: problem.exact_value(x) + 0.01 * torch.sin(2.0 * math.pi * x[:, 0])
    x = torch.rand(2048, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    slack = lambda at: slack_function(problem, value)(at).detach()
    found = extremes(slack_function(problem, value), x, slack(x), PEAKS, CLIMBED)
    assert found.shape == (2 * PEAKS, 2)
    assert bool((slack(found[:PEAKS]) <= -(-slack(x)).topk(PEAKS).values + 1e-12).all())
    assert bool((slack(found[PEAKS:]) >= slack(x).topk(PEAKS).values - 1e-12).all())


@pytest.mark.parametrize(("off", "again"), [(1e-9, False), (0.1, True)])
def test_spikes_are_sought_again_while_those_found_raise_the_bound(off, again, optimal, monkeypatch):
    problem, loop, samples = optimal
    slack, terms = judged(loop, lambda x: problem.exact_value(x) + off, samples, zoo.rough_network(2, 3, size=0.1))
    climbs = []

    def climb(self, how, ascents, steps=60):
        climbs.append(how)
        self.met = self.met._replace(slack=1.5 * self.met.slack)

    monkeypatch.setattr(LoweredSlack, "climb", climb)
    slack.climbed_lowest(terms, ascents=1)
    assert (len(climbs) > 1) == again


@pytest.mark.nightly
@pytest.mark.parametrize("side", [0, 1])
def test_peaks_in_hollows_are_sought_on_both_sides_of_the_slack(side):
    problem, sign = Still(), 2 * side - 1
    loop = ClosedLoop(problem, lambda x: torch.zeros_like(x))
    slack = LoweredSlack(
        loop, lambda x: problem.state_cost(x) + sign * hidden_peak(x), Samples.of(loop, zoo.states(problem, 4000))
    )
    slack.climb(UNCHANGED, 32)
    assert slack.suprema()[side] < 1.001 * HILLS
    assert slack.seek(UNCHANGED, 32)
    assert slack.suprema()[side] == pytest.approx(top(), rel=1e-4)
    found = slack.extrema(UNCHANGED, 32)[side]
    assert found.points == 4000
    assert found.ascents >= 32 + 2 * 32 * 64
    slack.climb(UNCHANGED, 32)
    assert not slack.seek(UNCHANGED, 32)
    # On other samples what was sought once counts without another search.
    other = LoweredSlack(loop, slack.value, Samples.of(loop, zoo.states(problem, 500)), sought=slack.sought)
    assert other.suprema()[side] == pytest.approx(top(), rel=1e-4)
    assert other.extrema(UNCHANGED, 32)[side].ascents == found.ascents - 32 + min(32, 500)


def test_no_controller_is_asked_for_no_state():
    """Nothing is within reach of a slack that is the same everywhere."""
    problem, asked = Still(), []

    def policy(x):
        asked.append(len(x))
        return torch.zeros_like(x)

    loop = ClosedLoop(problem, policy)
    slack = LoweredSlack(loop, problem.state_cost, Samples.of(loop, zoo.states(problem, 1000)))
    assert not slack.seek(UNCHANGED, 8)
    assert min(asked) > 0
    assert slack.extrema(UNCHANGED, 8)[0].ascents == 8 + 8 * 64
