"""Starts are drawn from `mu0` however narrow it is, with exact weights; where its mass is not found, that is said."""

import math

import numpy as np
import pytest
import torch

from ocp_torch.certificate.checks.wellposed import check_problem
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.simulated.performance import SIMULATION_REPLICATE, Simulation, starting_points
from ocp_torch.certificate.statistics.estimate import Estimate, replicated_samples
from ocp_torch.control.policies import zero_policy
from ocp_torch.gym.environment import ControlEnvironment
from ocp_torch.maths.mixture_fit import fitted_mixture
from ocp_torch.maths.mixtures import Mixture, effective_part
from ocp_torch.maths.sampling import evaluation_points
from ocp_torch.problems import Problem, Simulator
from ocp_torch.problems.constants import OCCUPATION_WEIGHT, resolve_constants
from ocp_torch.problems.samples import Samples
from ocp_torch.problems.starts import drawn_starts, initial_points, start_distribution
from ocp_torch.runs.metrics.trial import random_starts
from support import zoo
from support.adversarial import TURN, NarrowStart, gaussian, short_way

NARROW = {
    "1-d": ([0.37], 0.004),
    "1-d needle": ([0.9137], 1e-6),
    "2-d": ([0.37, 0.91], 0.004),
    "2-d thin": ([0.002, 0.6], [0.08, 0.001]),
    "3-d": ([0.1, 0.2, 0.999], 0.004),
    "5-d": ([0.37, 0.9, 0.1, 0.5, 0.7], 0.004),
    "5-d wider": ([0.37, 0.9, 0.1, 0.5, 0.7], 0.05),
}


@pytest.fixture(params=NARROW, scope="module")
def narrow(request) -> NarrowStart:
    return NarrowStart(*NARROW[request.param])


def assert_near(estimate: Estimate, truth: float, most: float):
    low, high = estimate.interval(0.999)
    assert low <= truth <= high
    assert high - low <= most * abs(truth)


@pytest.mark.nightly
def test_doing_nothing_from_a_narrow_start_costs_what_it_costs(narrow):
    perf = Simulation(narrow, zero_policy(narrow), 64, 8, seed=0).run().perf
    assert_near(perf, narrow.idle, 0.4)


def test_the_random_horizon_starts_there_too():
    problem = NarrowStart(*NARROW["2-d"])
    perf = Simulation(problem, zero_policy(problem), 128, 8, seed=0, horizon="random").run().perf
    assert_near(perf, problem.idle, 0.3)


def test_the_lower_side_knows_its_mean_over_a_narrow_start(narrow):
    sets = replicated_samples(narrow, 2048, 8, seed=0, divergences=False)
    V = lambda x: 3.0 + (TURN * x).cos().mean(dim=-1)
    assert_near(Estimate.of(SampledValue(narrow, V, sets, ascents=4).initial), 3.0 + narrow.mean_wave(), 0.15)


def test_the_mass_of_a_narrow_start_is_found_to_be_one(narrow):
    posed = check_problem(narrow, replicated_samples(narrow, 2048, 8, seed=0, divergences=False))
    assert posed.sound
    assert posed.mass == pytest.approx(1.0, abs=0.05)


class Start(Problem):
    """`dx = u` from a start that is given by a function."""

    def __init__(self, dim, density) -> None:
        super().__init__(dim=dim)
        self.density = density

    def state_cost(self, x):
        return torch.ones_like(x[:, 0])

    def initial_density(self, x):
        return self.density(x)


def inside(x, width):
    return (short_way(x, [0.3] * x.shape[1]).abs() < 0.5 * width).all(dim=-1).to(x)


UNSOUND = {
    "half of it": (2, lambda x: 0.5 * gaussian(x, [0.2, 0.7], 0.004), "integrates to 0."),
    "never met": (3, lambda x: inside(x, 1e-4) * 1e12, "integrates to 0 "),
    "a part is never met": (3, lambda x: 0.7 + 0.3e12 * inside(x, 1e-4), "integrates to 0.7"),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_mass_that_is_not_there_or_not_found_is_said(name):
    dim, density, words = UNSOUND[name]
    problem = Start(dim, density)
    posed = check_problem(problem, replicated_samples(problem, 512, 8, seed=0, divergences=False))
    assert not posed.sound
    assert any(words in w for w in posed.warnings)


def test_a_start_that_a_few_states_carry_is_no_known_mass():
    """Uniform states that meet a needle by chance: the interval of the mass holds 1, and nothing is known."""
    problem = Start(2, lambda x: gaussian(x, [0.2, 0.7], 0.004))
    sets = [Samples.of(problem, evaluation_points(4096, 2, r, 0), divergences=False) for r in range(8)]
    assert not check_problem(problem, sets).sound


@zoo.on(("circle rho=2", "torus 3-d random", "manufactured 2-d mu0", "swing"))
def test_broad_starts_are_the_points_they_were(problem):
    points, mass = starting_points(problem, 32, 2, seed=5)
    sets = [evaluation_points(32, problem.dim, SIMULATION_REPLICATE + r, 5) for r in range(2)]
    assert torch.equal(points, torch.cat(sets))
    assert torch.equal(mass, problem.initial_density(points))
    assert all(bool((s.weight == 1.0).all()) for s in replicated_samples(problem, 32, 2, 5, divergences=False))


def test_weights_are_one_over_the_density_of_the_points():
    """Histograms of the points themselves, against the density that is claimed."""
    distribution = Mixture(
        torch.tensor([0.3, 0.4], dtype=torch.float64),
        torch.tensor([[0.1], [0.95]], dtype=torch.float64),
        torch.tensor([[0.3], [0.02]], dtype=torch.float64),
    )
    x, weight = distribution.draw(2**15, 0, 0)
    bins = 64
    counts = torch.histc(x[:, 0], bins, 0.0, 1.0) / len(x)
    fine = ((torch.arange(bins * 64, dtype=torch.float64) + 0.5) / (bins * 64)).unsqueeze(-1)
    claimed = distribution.density(fine).reshape(bins, 64).mean(dim=1) / bins
    assert float((counts - claimed).abs().max()) < 3e-4
    assert float(weight.mean()) == pytest.approx(1.0, abs=1e-3)
    assert float(weight.max()) <= 1.0 / 0.3 + 1e-3


def two_peaks(x):
    return 0.5 * gaussian(x, [0.2, 0.2], 0.01) + 0.5 * gaussian(x, [0.7, 0.8], 0.003)


@pytest.mark.parametrize(
    ("dim", "function", "truth"),
    [
        (2, two_peaks, 1.0),
        (2, lambda x: 0.9 + 0.1 * gaussian(x, [0.3, 0.6], 0.004), 1.0),
        (1, lambda x: inside(x, 1e-3), 1e-3),
        (3, lambda x: inside(x, 0.05), 0.05**3),
        (2, lambda x: gaussian(x[:, :1], [0.4], 0.004), 1.0),
    ],
    ids=["two peaks", "a peak on a plain", "a slit", "a box", "a ridge"],
)
def test_what_is_fitted_serves_to_integrate(dim, function, truth):
    distribution = fitted_mixture(function, dim).scaled(0.875)
    sets = [distribution.draw(512, r, 1) for r in range(8)]
    values = [weight * function(x) for x, weight in sets]
    assert_near(Estimate.of([float(v.mean()) for v in values]), truth, 0.2)
    assert effective_part(torch.cat(values)) > 0.25


def test_starts_that_count_the_same_are_drawn_from_the_density():
    problem = NarrowStart(*NARROW["2-d"])
    for x in (drawn_starts(problem, 2000, seed=0), random_starts(problem, 500, seed=0)):
        away = short_way(x, problem.centre)
        assert float(away.std()) == pytest.approx(0.004, rel=0.05)
        assert float(away.mean().abs()) < 4.0 * 0.004 / math.sqrt(len(x))


@pytest.mark.parametrize("name", ["2-d", "5-d"])
def test_the_guess_of_M_knows_how_high_a_narrow_start_is(name):
    problem = NarrowStart(*NARROW[name])
    peak = float(problem.initial_density(torch.tensor([problem.centre], dtype=torch.float64)))
    assert 0.5 * OCCUPATION_WEIGHT * peak < resolve_constants(problem).M <= OCCUPATION_WEIGHT * peak


def test_episodes_of_the_environment_start_there():
    pytest.importorskip("gymnasium")
    environment = ControlEnvironment(NarrowStart(*NARROW["2-d"]), control_bound=1.0)
    states = [environment.reset(seed=k)[1]["state"] for k in range(20)]
    assert all(float(short_way(torch.as_tensor(x), [0.37, 0.91]).abs().max()) < 0.03 for x in states)


def test_a_simulator_is_asked_at_few_states_for_it():
    asked = []

    def oracle(x):
        asked.append(len(x))
        return np.ones(len(x)), None, np.broadcast_to(np.eye(2), (len(x), 2, 2))

    problem = Simulator(oracle, dim=2)
    asked.clear()
    assert start_distribution(problem).is_uniform
    assert sum(asked) < 6000


def test_the_same_starts_come_again():
    problem, other = NarrowStart(*NARROW["3-d"]), NarrowStart(*NARROW["3-d"])
    assert all(
        torch.equal(a, b)
        for a, b in zip(initial_points(problem, 64, 3, 7), initial_points(other, 64, 3, 7), strict=True)
    )
    assert not start_distribution(problem).is_uniform
