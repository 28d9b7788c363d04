"""Spikes that a few sampled states carry: more states are drawn there, or the interval says that it may be off."""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product

import pytest
import torch

from ocp_torch.certificate import Run, Trained, certify_fields
from ocp_torch.certificate.simulated import unseen
from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.certificate.statistics.estimate import Estimate, replicated_samples
from ocp_torch.certificate.statistics.tails import beyond_largest, rarity, sharpened, widened
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.control.policies import NETWORK, zero_policy
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems import Problem
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.starts import fits
from support import zoo
from support.adversarial import TURN, Spike, gaussian, short_way
from support.formulas import Field
from support.honesty import BARE

SPIKES = {
    "1-d": (1, 0.0025, 0.0),
    "1-d needle": (1, 2e-5, 0.5),
    "2-d": (2, 0.0025, 0.0),
    "2-d on waves": (2, 0.0025, 0.5),
    "3-d": (3, 0.005, 0.0),
    "3-d on waves": (3, 0.01, 0.5),
    "5-d": (5, 0.03, 0.0),
}


def spike(name: str, seed: int = 0, **options) -> Spike:
    dim, sigma, wavy = SPIKES[name]
    centre = torch.rand(dim, generator=torch.Generator().manual_seed(seed + 100)).tolist()
    return Spike(centre, sigma, 0.2, wavy, **options)


def assert_covers(estimate: Estimate, truth: float, most: float = 0.05):
    low, high = estimate.interval(0.999)
    assert low <= truth <= high
    assert high - low <= most * truth


@pytest.mark.nightly
@pytest.mark.parametrize("name", SPIKES)
def test_bounds_of_a_closed_loop_know_a_spike_of_the_cost(name):
    """Doing nothing keeps the uniform law: `J` and the Lagrangian bound are the mean cost."""
    problem = spike(name)
    loop = ClosedLoop(problem, zero_policy(problem))
    zero = lambda x: 0.0 * x[:, 0]
    judge = lambda sets: closed_loop_bounds(loop, zero, zero, loop.samples_of(sets), 1, "value")
    found = sharpened(judge, problem, replicated_samples(problem, 2048, 8, 0, divergences=False), 0)
    for estimate in (found.lagrangian, found.J, found.below):
        assert_covers(estimate, problem.idle)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("name", "speed"),
    [("1-d needle", 0.0), ("2-d", 0.0), pytest.param("2-d", 0.05, marks=pytest.mark.nightly), ("3-d", 0.0)],
)
def test_a_simulated_cost_knows_a_spike_where_trajectories_start(name, speed):
    problem = spike(name, speed=speed)
    low, high = Simulation(problem, zero_policy(problem), 64, 8, 0).run().perf.interval(0.999)
    assert low <= problem.idle <= high


@dataclass(frozen=True)
class Mean:
    """The mean of a function that no search of the problem's data would find."""

    estimate: Estimate
    contributions: list = field(default_factory=list)


@pytest.mark.parametrize("seed", range(4))
def test_states_are_drawn_where_a_few_carried_the_mean(seed):
    """A spike of an integrand, such as a fitted density at a sink, not of the data."""
    problem = zoo.build("manufactured 2-d q=2")
    centre = torch.rand(2, generator=torch.Generator().manual_seed(seed)).tolist()
    g = lambda x: 1.0 + 0.3 * gaussian(x, centre, 0.006)

    def judge(sets):
        values = [s.weight * g(s.x) for s in sets]
        return Mean(widened(Estimate.of([float(v.mean()) for v in values]), values), [values])

    sets = replicated_samples(problem, 2048, 8, seed, divergences=False)
    assert rarity(torch.cat(judge(sets).contributions[0]), 1.0) > 0.0
    found = sharpened(judge, problem, sets, seed)
    assert rarity(torch.cat(found.contributions[0]), 1.0) == 0.0
    assert_covers(found.estimate, 1.3, 0.03)


@pytest.mark.parametrize("hits", [2.0, 5.0, 15.0])
def test_an_interval_of_rare_events_covers_as_often_as_it_says(hits):
    """`N` draws, each with a small chance of a large contribution; wherever one was met at all."""
    count, generator, missed, met = 16384, torch.Generator().manual_seed(0), 0, 0
    for _ in range(300):
        rare = torch.rand(8, count // 8, generator=generator, dtype=torch.float64) < hits / count
        values = 1.0 + rare * (0.2 * count / hits)
        if not rare.any():
            continue
        low, high = widened(Estimate.of(values.mean(dim=1).tolist()), list(values)).interval(0.95)
        met, missed = met + 1, missed + (not low <= 1.2 <= high)
    assert missed <= 0.05 * met


def test_what_many_states_carry_is_left_alone():
    x = torch.randn(16384, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert rarity(x, 1.0) == rarity(x.exp(), 1.0) == rarity(torch.ones(9), 1.0) == 0.0
    one = torch.cat([torch.ones(16383), torch.tensor([1.01])])
    assert rarity(one, 1.0) == 0.0  # rare, but nothing beside the answer


@zoo.on((*zoo.NATURAL, *zoo.FEW))
def test_problems_without_spikes_keep_their_states(problem):
    density, cost = fits(problem)
    assert cost.is_uniform
    # A start that says where it is, in a part of a box, is known and no spike that was found.
    assert density.is_uniform or problem.initial_mixture is not None


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["2-d", "2-d on waves"])
def test_a_certificate_of_doing_nothing_holds_what_it_costs(name):
    problem = spike(name)
    fields = Fields({"control_density": Field(lambda x: 0.0 * x), "log_occupation": Field(lambda x: 0.0 * x[:, 0])})
    trained = Trained(fields, NETWORK, partial(PeriodicMLP, width=8, depth=1))
    settings = replace(BARE, points=8192, trajectories=32, tolerance=5e-5)
    certificate = certify_fields(problem, trained, resolve_constants(problem), settings, Run("spike", "primal"))
    assert_covers(certificate.upper["J"], problem.idle)
    low, high = certificate.perf["density"].interval(0.999)
    assert low <= problem.idle <= high


class Far(Problem):
    """Costs 1 but for a needle, which states that start far from it reach late, or by a rare fluctuation of the noise."""

    def __init__(self, **options) -> None:
        super().__init__(dim=1, **options)

    def state_cost(self, x):
        return 1.0 + 1e5 * (-0.5 * (short_way(x, 0.9) / 0.01).square()).exp()[:, 0]

    def drift(self, x):
        return -0.9 * (TURN * (x - 0.4)).sin() if self.noisy else torch.full_like(x, 0.1)

    def initial_density(self, x):
        return gaussian(x, [0.4 if self.noisy else 0.05], 0.02)


@pytest.mark.parametrize(("options", "horizon"), [({}, "random"), ({"noise": 0.02}, "truncated")])
def test_a_place_that_no_random_path_met_and_that_costs_much_is_in_the_interval(options, horizon):
    """Nothing of it is seen in the paths; at the random times it costs 5 more in truth, by its closed form."""
    problem = Far(discount=1.0, **options)
    found = Simulation(problem, zero_policy(problem), 64, 4, 0, horizon=horizon, tolerance=1e-2).run().perf
    assert found.value < 1.5
    assert found.above > 6.3


def test_where_all_that_costs_much_was_met_nothing_is_added():
    problem = Far(discount=1.0, noise=0.02)
    problem.state_cost = lambda x: 1e5 * (1.0 + (TURN * (x[:, 0] - 0.4)).cos())  # most where all start
    found = Simulation(problem, zero_policy(problem), 64, 4, 0, tolerance=1e-2).run().perf
    assert found.bias < 0.05 * found.value


@pytest.mark.parametrize("power", [0.5, 0.65, 0.8])
def test_a_cost_without_a_variance_widens_the_interval_of_a_mean_by_what_was_not_met(power):
    """`E |x|^-p` over evenly spread states and importance samples: the scatter of those met says too little."""
    missed = 0
    for seed in range(40):
        generator = torch.Generator().manual_seed(seed)
        x, weight = torch.rand(2048, generator=generator, dtype=torch.float64), torch.ones(2048, dtype=torch.float64)
        if seed % 2:  # half of the states in the innermost thousandth
            near = torch.rand(2048, generator=generator) < 0.5
            x = torch.where(near, 1e-3 * x, x)
            weight = 1.0 / (0.5 + 500.0 * (x < 1e-3))
        cost = x ** (-power)
        estimate, truth = float((weight * cost).mean()), 1.0 / (1.0 - power)
        error = 2.0 * float((weight * cost).std()) / math.sqrt(2048.0)
        missed += abs(estimate - truth) > error + beyond_largest(cost, weight, estimate)
    assert missed <= 4


@pytest.mark.parametrize(
    "cost", [lambda x: x, lambda x: (6.0 * x).exp(), lambda x: -x.log(), lambda x: (x < 0.01).double()]
)
def test_where_the_largest_fall_off_fast_it_widens_nothing(cost):
    for seed, count in product(range(20), (512, 4096)):
        x = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        assert beyond_largest(cost(x), torch.ones_like(x), 1.0) == 0.0


class Singular(Problem):
    """Nothing moves; in two coordinates a cost that rises as `r^-1.6` about the middle, where the starts are importance
    samples of widely different weights."""

    def __init__(self):
        super().__init__(dim=2, control_dim=1, discount=1.0)

    def state_cost(self, x):
        return ((x - 0.5).norm(dim=1) + 1e-9) ** -1.6

    def drift(self, x):
        return torch.zeros_like(x)

    def control_matrix(self, x):
        return torch.ones(len(x), 2, 1, dtype=x.dtype)

    def initial_density(self, x):
        return torch.ones_like(x[:, 0])


@pytest.mark.parametrize("seed", range(3))
def test_a_cost_without_a_variance_is_noticed_among_starts_of_different_weights(seed):
    found = Simulation(Singular(), zero_policy(Singular()), 256, 8, seed, tolerance=1e-2).run().perf
    assert found.bias > 0.01 * found.value


def test_what_falls_off_slowly_counts_no_further_than_the_largest_rate(monkeypatch):
    """No path costs more than 2, so that 3 / 2,048 of them are all that is left."""
    monkeypatch.setattr(unseen, "beyond_largest", lambda results, weights, size: 1.0)
    problem = Singular()
    problem.state_cost = lambda x: 1.0 + (TURN * x[:, 0]).cos()
    found = Simulation(problem, zero_policy(problem), 256, 8, 0, tolerance=1e-3).run().perf
    assert 0.5 * 3.0 / 2048 < found.bias < 6.0 * 3.0 / 2048


def test_of_rates_without_a_largest_one_all_counts(monkeypatch):
    monkeypatch.setattr(unseen, "beyond_largest", lambda results, weights, size: 100.0)
    found = Simulation(Singular(), zero_policy(Singular()), 256, 8, 0, tolerance=1e-2).run().perf
    assert found.bias >= 100.0


class Carousel(Problem):
    """Every path goes round and through a narrow ridge of the cost, fastest away from it."""

    def __init__(self, height: float = 100.0):
        super().__init__(dim=2, control_dim=1, discount=1.0)
        self.height = height

    def state_cost(self, x):
        return (
            1.0 + self.height * (60.0 * ((TURN * (x[:, 0] - 0.3)).cos() + (TURN * (x[:, 1] - 0.6)).cos() - 2.0)).exp()
        )

    def drift(self, x):
        return torch.stack([1.2 + (TURN * (x[:, 0] - 0.3)).cos(), torch.zeros_like(x[:, 1])], dim=1)

    def control_matrix(self, x):
        return torch.ones(len(x), 2, 1, dtype=x.dtype)

    def initial_density(self, x):
        return torch.ones_like(x[:, 0])


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))])
def test_what_falls_off_slowly_counts_as_far_as_paths_from_the_peaks_cost(seed, monkeypatch):
    """A rate of 101 is met for a moment alone: no path costs a fifth of that, and the search finds the dearest."""
    found = []
    largest = unseen.largest_result_of
    monkeypatch.setattr(unseen, "largest_result_of", lambda *how: found.append(largest(*how)) or found[-1])
    monkeypatch.setattr(unseen, "beyond_largest", lambda results, weights, size: 100.0)
    problem = Carousel()
    results = Simulation(problem, zero_policy(problem), 64, 8, seed, tolerance=1e-2).run()
    more = Simulation(problem, zero_policy(problem), 512, 2, seed + 7, tolerance=1e-2)
    monkeypatch.setattr(
        unseen, "beyond_largest", lambda results, weights, size: found.append(float(results.max())) or 0.0
    )
    more.run()
    said, dearest = found
    assert dearest <= said <= 2.5 * dearest < 0.5 * problem.height
    assert results.perf.bias < 3.0 * 3.0 / 512 * said  # with what is left of steps and chance


def test_of_few_states_nothing_is_said():
    x = torch.linspace(0.01, 1.0, 200, dtype=torch.float64)
    assert beyond_largest(x**-0.9, torch.ones_like(x), 1.0) == 0.0
