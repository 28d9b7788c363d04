"""The exact identities behind the bounds of one closed loop, against prescribed truth and against simulation."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.certificate.statistics.estimate import Estimate, replicated_samples
from ocp_torch.certificate.upper import policy_evaluation
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.certificate.upper.multiples import Terms, best_multiples, terms_on
from ocp_torch.certificate.upper.policy_evaluation import (
    StageSettings,
    fit_closed_loop,
)
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.maths.runge_kutta import discounted_integral
from ocp_torch.maths.sampling import SobolSampler
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo
from support.formulas import Field


def optimal_loop_samples(problem, count=2**13):
    """The closed loop of the exact controller, whose `V^u` and `mu^u` are the exact `V*` and `mu*`."""
    loop = ClosedLoop(problem, problem.exact_control)
    return loop, [Samples.of(loop, s.x) for s in replicated_samples(problem, count, 8, 0, divergences=False)]


def bellman_slack(loop, value, samples):
    generator = Generator.of(loop, samples)
    V = generator.jet(value)
    return V.value, generator.hjb_slack(V)


@zoo.on(zoo.FEW_SMOOTH)
def test_any_value_function_gives_the_performance_by_its_slack_on_the_occupation_density(problem):
    """`Perf(u) = E[V mu0] - E_{mu^u}[Q_u]`."""
    loop, sets = optimal_loop_samples(problem)
    value = zoo.rough_network(problem.dim, 5, size=0.3)

    def performance(samples):
        v, slack = bellman_slack(loop, value, samples)
        return float((v * samples.mu0 - problem.exact_occupation(samples.x) * slack).mean())

    found = Estimate.of([performance(s) for s in sets])
    assert found.value == pytest.approx(problem.exact_optimum, abs=5.0 * found.se + 1e-9)
    assert found.se < 1e-2 * problem.exact_optimum


@zoo.on(zoo.FEW_SMOOTH)
def test_any_density_gives_the_performance_once_the_value_of_its_residual_is_added(problem):
    """`Perf(u) = E[(f + R(u)) mu + V r] + E[(V^u - V) r]`."""
    loop, sets = optimal_loop_samples(problem)
    value, log_mu = (zoo.rough_network(problem.dim, seed, size=0.2) for seed in (6, 7))

    def performance(samples):
        mu, spent = Generator.of(loop, samples).occupation_outflow(log_mu)
        r, v = samples.mu0 - spent, value(samples.x)
        lagrangian = samples.f * mu + v * r
        return float((lagrangian + (problem.exact_value(samples.x) - v) * r).mean())

    found = Estimate.of([performance(s) for s in sets])
    assert found.value == pytest.approx(problem.exact_optimum, abs=5.0 * found.se + 1e-9)
    assert found.se < 1e-2 * problem.exact_optimum


@pytest.mark.nightly
@zoo.on(zoo.QUIET)
def test_the_value_differs_from_that_of_the_loop_by_the_slack_met_along_its_trajectories(problem):
    """`V(x) - V^u(x) = rho int e^{-rho t} Q_u(x_t) dt`, state by state."""
    loop = ClosedLoop(problem, problem.exact_control)
    value, x = zoo.rough_network(problem.dim, 8, size=0.3), zoo.states(problem, 20)
    along = lambda y: (loop.drift(y), bellman_slack(loop, value, Samples.of(loop, y, divergences=False))[1])
    met, _ = discounted_integral(along, x, problem.discount, horizon=14.0 / problem.discount, steps=120)
    torch.testing.assert_close(value(x) - problem.exact_value(x), met, rtol=1e-4, atol=1e-4)


@pytest.mark.nightly
@zoo.on(zoo.FEW_SMOOTH)
def test_the_bounds_of_a_poor_controller_are_above_its_own_performance(problem):
    """Not only above OPT: a bound speaks of the controller it is given."""
    bump = zoo.rough_network(problem.dim, 9, size=0.05)
    value = lambda x: problem.exact_value(x) + bump(x)
    policy = ValuePolicy(problem, value)
    loop = ClosedLoop(problem, policy)
    sets = replicated_samples(problem, 2048, 8, 0, divergences=False)
    log_mu = lambda x: problem.exact_occupation(x).log() + 0.3 * bump(x)
    constants = closed_loop_bounds(loop, value, log_mu, [Samples.of(loop, s.x) for s in sets], 8, "value")
    initial = [float((value(s.x) * s.mu0).mean()) for s in sets]
    perf = Simulation(problem, policy, 64, 8, 0, value=value, initial=initial, tolerance=1e-3).run().perf
    assert perf.value - 3.0 * perf.se > problem.exact_optimum
    for bound in (constants.lagrangian, constants.J):
        assert bound.value >= perf.value - perf.bias - 4.0 * (perf.se + bound.se)


@pytest.mark.nightly
def test_the_stage_takes_another_round_only_while_the_residual_costs_too_much(monkeypatch):
    monkeypatch.setattr(policy_evaluation, "STEEP", torch.inf)
    problem = zoo.build("manufactured 2-d q=2")
    network = partial(PeriodicMLP, modes=1, width=16, depth=2)
    fields = Fields.build(problem, ("value",), network, 0)
    policy = ValuePolicy(problem, problem.exact_value)
    settings = StageSettings(steps=40, rounds=3, batch=64)
    fit = lambda **change: fit_closed_loop(
        problem, policy, fields, network, resolve_constants(problem), replace(settings, **change), seed=0
    )
    weights = lambda fitted: torch.cat([p.flatten() for p in fitted.log_occupation.parameters()])
    once = weights(fit(rounds=1))
    assert torch.equal(weights(fit(good_excess=1e3)), once)
    assert not torch.equal(weights(fit(good_excess=1e-12)), once)


@pytest.mark.nightly
@pytest.mark.parametrize(("rounds", "good", "steps"), [(1, 1e-12, 30), (2, 1e-12, 60), (3, 1e-12, 120), (3, 1e12, 100)])
def test_where_the_slack_is_steep_one_long_round_is_made_until_the_excess_is_good(rounds, good, steps, monkeypatch):
    problem, made = zoo.build("manufactured 2-d q=2"), []
    network = partial(PeriodicMLP, modes=1, width=16, depth=2)
    fields = Fields({"value": network(problem.dim)})
    settings = StageSettings(steps=30, rounds=rounds, batch=16, good_excess=good)
    counted = policy_evaluation.advance
    monkeypatch.setattr(policy_evaluation, "advance", lambda *a: made.append(len(a[2](a[3]))) or counted(*a))
    policy = ValuePolicy(problem, problem.exact_value)
    fit_closed_loop(problem, policy, fields, network, resolve_constants(problem), settings, seed=0)
    assert made == [32] * steps


@pytest.mark.parametrize("good_from", [1, 2])
def test_a_round_ends_at_the_first_look_that_finds_a_good_excess(good_from, monkeypatch):
    problem, made, looks = zoo.build("manufactured 2-d q=2"), [], []
    network = partial(PeriodicMLP, modes=1, width=16, depth=2)
    counted = policy_evaluation.advance
    monkeypatch.setattr(policy_evaluation, "advance", lambda *a: made.append(0) or counted(*a))
    seen = lambda self, terms: looks.append(len(made)) or (0.0 if len(looks) >= good_from else 1.0)
    monkeypatch.setattr(policy_evaluation.LoweredSlack, "excess", seen)
    fields, policy = Fields({"value": network(problem.dim)}), ValuePolicy(problem, problem.exact_value)
    settings = StageSettings(steps=200, rounds=1, batch=16)
    fit_closed_loop(problem, policy, fields, network, resolve_constants(problem), settings, seed=0)
    assert looks == [100, 125][:good_from]
    assert len(made) == looks[-1]


@pytest.mark.parametrize(
    ("excess", "steps", "made", "recorded"),
    [
        (1.0, 600, 300, False),
        (1.0, 300, 250, False),
        (0.2, 300, 300, False),
        (1.0, 40, 40, False),
        (1.0, 300, 300, True),
    ],
)
def test_a_fit_ends_half_way_where_its_bound_will_be_of_no_use(excess, steps, made, recorded, monkeypatch):
    """Of a recording `J` is all there is, which takes no supremum of the slack."""
    problem, taken = zoo.build("manufactured 2-d q=2"), []
    network = partial(PeriodicMLP, modes=1, width=8, depth=1)
    counted = policy_evaluation.advance
    monkeypatch.setattr(policy_evaluation, "advance", lambda *a: taken.append(0) or counted(*a))
    monkeypatch.setattr(policy_evaluation.LoweredSlack, "excess", lambda self, terms: excess)
    monkeypatch.setattr(type(problem), "has_simulator", not recorded)
    fields, policy = Fields({"value": network(problem.dim)}), ValuePolicy(problem, problem.exact_value)
    settings = StageSettings(steps=steps, rounds=1, batch=16)
    fit_closed_loop(problem, policy, fields, network, resolve_constants(problem), settings, seed=0)
    assert len(taken) == made


def test_a_pool_makes_what_is_drawn_and_gives_the_same_states_again_only_after_all(monkeypatch):
    monkeypatch.setattr(policy_evaluation, "EXCESS_STATES", 8)
    problem = zoo.build("manufactured 2-d q=2")
    loop = ClosedLoop(problem, ValuePolicy(problem, problem.exact_value))
    pool = policy_evaluation.Pool(loop, 1, torch.zeros(()), 20)
    assert len(pool.samples) == 8
    first = [pool.draw(6).x for _ in range(3)]
    assert len(pool.samples) == 20
    wanted = SobolSampler(2, 1, torch.float32).draw(20)
    assert torch.equal(torch.cat(first), wanted[:18])
    assert torch.equal(pool.draw(6).x, torch.cat([wanted[18:], wanted[:4]]))
    pool.grow(30)
    assert torch.equal(pool.draw(6).x, SobolSampler(2, 1, torch.float32).draw(30)[24:])


@pytest.mark.nightly
@pytest.mark.parametrize("solved", [False, True])
def test_the_first_round_ends_early_where_v_is_solved_so_well_that_any_density_will_do(solved, monkeypatch):
    problem, steps = zoo.build("manufactured 2-d q=2"), []
    network = partial(PeriodicMLP, modes=1, width=16, depth=2)
    value = Field(problem.exact_value) if solved else network(problem.dim)
    fields = Fields({"value": value})
    policy, settings = ValuePolicy(problem, problem.exact_value), StageSettings(steps=250, rounds=1, batch=16)
    counted = policy_evaluation.advance
    monkeypatch.setattr(policy_evaluation, "advance", lambda *a: steps.append(0) or counted(*a))
    fit_closed_loop(problem, policy, fields, network, resolve_constants(problem), settings, seed=0)
    assert len(steps) == (100 if solved else 250)


@pytest.mark.nightly
def test_a_fit_whose_first_steps_lose_all_mass_is_begun_anew_more_slowly(monkeypatch):
    problem = zoo.build("manufactured 2-d q=2")
    network = partial(PeriodicMLP, modes=1, width=16, depth=2)
    fields = Fields.build(problem, ("value",), network, 0)
    policy, settings = ValuePolicy(problem, problem.exact_value), StageSettings(steps=200, rounds=1, batch=64, lr=1.0)
    x = torch.rand(4096, 2, generator=torch.Generator().manual_seed(0))

    def mass():
        constants = resolve_constants(problem)
        fitted = fit_closed_loop(problem, policy, fields, network, constants, settings, seed=0)
        return float(fitted.log_occupation(x).exp().mean())

    assert 0.5 < mass() < 2.0
    monkeypatch.setattr("ocp_torch.certificate.upper.policy_evaluation.LEAST_MASS", -1.0)
    assert mass() < 1e-6


@pytest.mark.nightly
@zoo.on(zoo.FEW_SMOOTH)
def test_the_bounds_do_not_depend_on_the_mass_that_mu_was_given(problem):
    """Every multiple of `mu` is a candidate, and none is above the bound of `mu` itself by more than chance allows."""
    loop = ClosedLoop(problem, problem.exact_control)
    value, bump = (zoo.rough_network(problem.dim, seed, size=0.1) for seed in (3, 4))
    shifted = lambda x: 1.0 + value(x)
    log_mu = lambda x: problem.exact_occupation(x).log() + bump(x)
    sets = [Samples.of(loop, s.x) for s in replicated_samples(problem, 512, 4, 0, divergences=False)]
    here, heavier = (
        closed_loop_bounds(loop, shifted, lambda x, c=c: log_mu(x) + c, sets, 1, "value") for c in (0.0, 0.2)
    )
    for name in ("lagrangian", "J", "below"):
        assert getattr(here, name).value == pytest.approx(getattr(heavier, name).value, rel=1e-4)
    terms = [terms_on(Generator.of(loop, s), shifted, log_mu)[0] for s in sets]
    bound = lambda t, scale: t.lagrangian(scale, 2.0, 0.5)
    assert sum(best_multiples(terms, bound)) <= sum(float(t.samples.mean(bound(t, 1.0))) for t in terms) + 1e-3


def test_no_multiple_is_chosen_on_the_half_it_is_evaluated_on():
    """Another slack in the first set moves what the second and the fourth give, and leaves the third alone."""
    problem = zoo.build("manufactured 2-d q=2")
    draw = torch.Generator().manual_seed(0)
    about = lambda mean: mean + 0.3 * torch.randn(64, generator=draw, dtype=torch.float64)
    samples = [Samples.of(problem, zoo.states(problem, 64, seed=s)) for s in range(4)]
    terms = [Terms(own, v=about(1.0), spent=about(0.0), r=about(0.0)) for own in samples]
    other = [replace(terms[0], spent=terms[0].spent + 0.4), *terms[1:]]
    for bound in (lambda t, s: t.lagrangian(s, 2.0, 0.5), lambda t, s: t.J(s, 3.0)):
        here, there = best_multiples(terms, bound), best_multiples(other, bound)
        assert here[2] == there[2]
        assert here[1] != there[1]
        assert here[3] != there[3]
