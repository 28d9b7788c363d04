"""The lower bound that needs no `M`: the best multiple of `V`, shifted by the supremum of its slack."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.certificate.lower.mollified import DIRECTIONS, EVALUATIONS, Mollified, mollified_shift
from ocp_torch.certificate.lower.sampled import SampledValue, attainable
from ocp_torch.certificate.lower.shifted import Shift, climbed, highest, scaled_by
from ocp_torch.certificate.lower.slack import MAX_THETA, SlackParts, slack_function
from ocp_torch.certificate.lower.tightened import tightened
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.fields import PeriodicMLP, Subsolution
from ocp_torch.maths.jets import jet
from ocp_torch.maths.peaks import Peaks
from ocp_torch.problems import Circle
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers import fitting
from support import zoo
from support.hidden_peak import PLACE, Still, hidden_peak


def parts_of(problem, value, count: int = 400) -> SlackParts:
    samples = Samples.of(problem, zoo.states(problem, count))
    generator = Generator.of(problem, samples)
    return SlackParts.of(generator, generator.jet(value))


def near(problem, seed: int, size: float):
    network = zoo.rough_network(problem.dim, seed, size=size)
    return lambda x: problem.exact_value(x) + network(x)


@zoo.on(zoo.FEW)
def test_the_slack_of_a_multiple_is_that_of_the_scaled_network(problem):
    V = near(problem, 2, 0.5)
    parts = parts_of(problem, V)
    for theta in (0.0, 0.3, 1.0, 1.4):
        torch.testing.assert_close(parts.slack(theta), slack_function(problem, lambda x, s=theta: s * V(x))(parts.x))


@pytest.mark.nightly
def test_a_peak_of_the_slack_in_a_hollow_counts():
    """All sampled states and ascents from the largest slacks leave it out, and claim a bound too high by its height."""
    problem = Still()
    value = lambda x: problem.state_cost(x) + 0.1 * hidden_peak(x)
    sets = replicated_samples(problem, 1024, 8, seed=0, divergences=False)
    shift = Shift(problem, value, sets, ascents=32, beside=[])
    around = torch.tensor(PLACE) + 0.01 * (zoo.states(problem, 20_000) - 0.5)
    everywhere = torch.cat([around, *(samples.x for samples in sets)])
    true = SlackParts.of(L := Generator.of(problem, Samples.of(problem, everywhere)), L.jet(value))
    best = max(
        t * shift.found.initial - float(true.slack(t).max()) for t in torch.linspace(0.0, MAX_THETA, 1501).tolist()
    )
    assert shift.bound == pytest.approx(best, abs=2e-3)
    assert shift.looked.bound > best + 0.04
    searches = (shift.largest.ascents - 32) / (32 * 64)
    assert shift.largest.points == 8 * 1024
    assert searches == int(searches) >= 2  # again, as one has found something
    other = replace(shift, value=lambda x: problem.state_cost(x) + 0.065 * torch.cos(2.0 * math.pi * x[:, 1]))
    assert shift.bound < other.bound < shift.looked.bound
    assert highest([shift, other]) is highest([other, shift]) is other


def test_a_peak_that_was_found_is_looked_at_in_averages_too(monkeypatch):
    problem = Still()
    value = lambda x: problem.state_cost(x) + 0.1 * hidden_peak(x)
    sets = replicated_samples(problem, 1024, 8, seed=0, divergences=False)
    own = Shift(problem, value, sets, ascents=32, beside=[])
    assert own.bound < own.looked.bound - 0.04
    # Averages over so small a radius have it nearly as high, and here a search among them finds nothing.
    monkeypatch.setattr("ocp_torch.certificate.lower.mollified.RADII", (2.0**-9,))
    monkeypatch.setattr(
        "ocp_torch.certificate.lower.shifted.steep_peaks", lambda *_: Peaks(torch.zeros(0, 2).double(), 0)
    )
    assert mollified_shift(own).bound < own.looked.bound - 0.02


def test_averages_take_off_narrow_spikes_and_are_not_asked_for_without_any():
    problem = zoo.build("circle rho=2")
    spike = lambda x: torch.exp(-(((x[:, 0] - 0.3) / 0.003) ** 2))
    sets = replicated_samples(problem, 64, 4, seed=0, divergences=False)
    own, spiked = (
        Shift(problem, value, sets, ascents=2, beside=[])
        for value in (problem.exact_value, lambda x: problem.exact_value(x) + 5e-4 * spike(x))
    )
    averaged = mollified_shift(spiked)
    assert averaged.radius > 0.0
    assert averaged.bound - spiked.bound > 0.5 * (own.bound - spiked.bound) > 1e-3
    assert averaged.bound <= problem.exact_optimum + 6.0 * averaged.estimate.se
    assert mollified_shift(own) is own


@zoo.on(zoo.FEW)
def test_the_multiple_is_the_best_on_a_line_of_multiples(problem):
    parts, initial = parts_of(problem, near(problem, 4, 0.2)), problem.exact_optimum
    bound = lambda theta: theta * initial - float(parts.slack(theta).max())
    best = max(bound(theta) for theta in torch.linspace(0.0, MAX_THETA, 1501).tolist())
    assert bound(scaled_by(parts, initial)) >= best - 1e-9


case = dict(name=st.sampled_from(zoo.FEW), seed=st.integers(0, 10**6), size=st.sampled_from([1e-2, 0.1, 1.0]))


@pytest.mark.nightly
@settings(max_examples=6)
@given(**case)
def test_scaling_never_loses_and_never_passes_the_optimum(name, seed, size):
    problem = zoo.build(name)
    V = near(problem, seed, size)
    sets = replicated_samples(problem, 512, 8, seed=0, divergences=False)
    found = SampledValue(problem, V, sets, ascents=8)
    pieces = [
        SlackParts.of(L, L.jet(V)) for L in (Generator.of(problem, s) for s in sets)
    ]  # the multiple 1, as it was before there was a choice
    plain = climbed(problem, V, SlackParts.join(pieces), 1.0, 8)
    initial = sum(found.initial) / len(found.initial)
    assert found.best.estimate.value >= initial - max(plain.value, 0.0) - 1e-12
    assert found.best.estimate.value <= problem.exact_optimum + 6.0 * found.best.estimate.se + 1e-9


@pytest.mark.nightly
@settings(max_examples=2)
@given(**case)
def test_averaging_never_loses_and_never_passes_the_optimum(name, seed, size):
    problem = zoo.build(name)
    sets = replicated_samples(problem, 512, 8, seed=0, divergences=False)
    found = SampledValue(problem, near(problem, seed, size), sets, ascents=8, search=True)
    assert found.best.bound >= found.own.bound
    assert found.best.estimate.value <= problem.exact_optimum + 6.0 * found.best.estimate.se + 1e-9


class Wave:
    """`cos(2 pi k . x)`; it counts no state outside the unit cell."""

    def __init__(self, wave: list[int]) -> None:
        self.wave, self.outside = torch.tensor(wave, dtype=torch.float64), 0

    def __call__(self, x):
        self.outside += int(((x < 0.0) | (x >= 1.0)).sum())
        return torch.cos(2.0 * math.pi * x @ self.wave)


@pytest.mark.parametrize("dim", [1, 3, 12])
def test_an_average_of_a_plane_wave_is_a_smaller_one(dim):
    wave = Wave([(3 * i) % 5 - 2 for i in range(dim)])
    averaged = Mollified(wave, dim, 0.03)
    neighbours = averaged.offsets[1:]
    assert len(neighbours) == 2 * min(dim, DIRECTIONS)
    axes = neighbours[: len(neighbours) // 2]
    torch.testing.assert_close(axes @ axes.T, 0.03**2 * torch.eye(len(axes), dtype=torch.float64))
    torch.testing.assert_close(neighbours[len(axes) :], -axes)
    x = torch.rand(40, dim, generator=torch.Generator().manual_seed(dim), dtype=torch.float64)
    left = (1.0 + torch.cos(2.0 * math.pi * neighbours @ wave.wave).sum()) / (len(neighbours) + 1)
    found = jet(averaged, x)
    value, gradient = found.value, found.gradient
    torch.testing.assert_close(value, left * wave(x))
    torch.testing.assert_close(averaged(x), value)
    slope = -2.0 * math.pi * left * torch.sin(2.0 * math.pi * x @ wave.wave)
    torch.testing.assert_close(gradient, slope.unsqueeze(-1) * wave.wave)
    assert wave.outside == 0


@pytest.mark.nightly
def test_a_narrow_spike_of_the_slack_is_averaged_out():
    problem = Circle()
    at = torch.tensor(0.3, dtype=torch.float64)
    bump = lambda x: torch.exp(-((x[:, 0] - at) / 2e-3).square())
    V = lambda x: problem.exact_value(x) + 2e-3 * bump(x)
    sets = replicated_samples(problem, 512, 8, seed=0, divergences=False)
    plain, averaged = (SampledValue(problem, V, sets, ascents=8, search=m) for m in (False, True))
    assert plain.best.radius == 0.0 < averaged.best.radius
    assert "averaged" in averaged.best.sentence
    assert "averaged" not in plain.best.sentence
    lost = problem.exact_optimum - torch.tensor([plain.best.estimate.value, averaged.best.estimate.value])
    assert lost[1] < 0.7 * lost[0]
    assert lost[1] >= -6.0 * averaged.best.estimate.se


@pytest.mark.parametrize(
    ("mollify", "unbounded", "expected"),
    [
        (None, True, True),
        (None, False, False),
        (True, False, True),
        (False, True, False),
    ],
)
def test_functions_made_of_V_are_tried_where_no_M_will_do_or_somebody_says_so(mollify, unbounded, expected):
    constants = replace(resolve_constants(Circle()), unbounded=unbounded)
    assert CertificateSettings(mollify=mollify).searches(constants) is expected


def test_a_mean_of_averages_starts_from_the_mean_of_V_that_more_states_give():
    """So that few states are as exact as all: the difference of both functions is small where either one scatters."""
    problem = zoo.build("circle rho=2")
    sets = replicated_samples(problem, 2**12, 8, seed=0, divergences=False)
    own = Shift(problem, problem.exact_value, sets, ascents=2, beside=[])
    averaged = replace(own, value=Mollified(problem.exact_value, problem.dim, 1e-3))
    few = [samples.take(slice(0, 64)) for samples in sets]
    mean = lambda shift: sum(shift.initial) / len(shift.initial)
    by_all, by_few = mean(averaged), mean(replace(averaged, sets=few))
    by_difference = mean(replace(averaged, sets=few, variate=own))
    assert abs(by_difference - by_all) < 0.1 * abs(by_few - by_all)


def test_large_sets_are_thinned_to_the_budget():
    problem = zoo.build(zoo.FEW[0])
    sets = replicated_samples(problem, 2**16, 8, seed=0, divergences=False)
    averaged = Mollified(problem.exact_value, problem.dim, 0.01)
    fewer = averaged.fitting(sets)
    states = sum(len(s) for s in fewer) * len(averaged.offsets)
    assert EVALUATIONS / 2 < states <= EVALUATIONS
    assert len(fewer) == 8
    torch.testing.assert_close(fewer[3].x, sets[3].x[: len(fewer[3])])


@pytest.mark.nightly
@zoo.on(zoo.FEW)
def test_a_value_function_of_the_wrong_size_is_put_right(problem):
    sets = replicated_samples(problem, 512, 8, seed=0, divergences=False)
    found = SampledValue(problem, lambda x: 0.8 * problem.exact_value(x), sets)
    assert found.own.theta == pytest.approx(1.25, abs=0.02)
    assert found.best.estimate.value == pytest.approx(problem.exact_optimum, rel=5e-3, abs=6.0 * found.best.estimate.se)


@pytest.mark.nightly
@zoo.on(zoo.FEW)
def test_a_subsolution_with_room_is_shifted_up(problem):
    sets = replicated_samples(problem, 512, 8, seed=0, divergences=False)
    found = SampledValue(problem, lambda x: problem.exact_value(x) - 5.0, sets)
    assert found.best.estimate.value == pytest.approx(problem.exact_optimum, rel=5e-3, abs=6.0 * found.best.estimate.se)


def test_a_useless_value_function_still_gives_about_the_smallest_cost():
    problem = Circle()
    sets = replicated_samples(problem, 512, 2, seed=0, divergences=False)
    rough = SampledValue(problem, zoo.rough_network(1, 0, size=50.0), sets)
    assert -1e-3 < rough.best.estimate.value < problem.exact_optimum
    assert rough.own.theta < 0.1


class Negative(Circle):
    def state_cost(self, x):
        return super().state_cost(x) - 0.1


def test_where_the_cost_is_negative_nothing_is_scaled():
    problem = Negative()
    sets = replicated_samples(problem, 512, 2, seed=0, divergences=False)
    found = SampledValue(problem, zoo.rough_network(1, 0), sets)
    assert found.own.theta == 1.0
    assert found.best.estimate.value <= problem.exact_optimum - 0.1


class Perturbed(PeriodicMLP):
    """`V*` plus a network: its last layer can take away what it put there."""

    def __init__(self, problem, size: float) -> None:
        super().__init__(problem.dim, modes=2, width=24, depth=2, activation="tanh", scale=size)
        self.problem = problem
        torch.nn.init.normal_(self.head.weight)

    def forward(self, x):
        return self.problem.exact_value(x) + super().forward(x)


def perturbed(problem, size=1e-3, seed=0):
    torch.manual_seed(seed)
    return Perturbed(problem, size).double().requires_grad_(False)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["manufactured 2-d q=1.5", "noisy 1-d"])
def test_a_value_trained_on_for_the_bound_comes_closer_to_the_optimum_from_below(name, monkeypatch):
    for plan in ("PLAN", "NOISY_PLAN"):
        monkeypatch.setattr(f"ocp_torch.certificate.lower.tightened.{plan}", (100.0, 150, 2e-2))
    monkeypatch.setattr("ocp_torch.certificate.lower.tightened.BATCH", 512)
    monkeypatch.setattr("ocp_torch.certificate.lower.mollified.RADII", (1.0 / 64.0,))
    for least in ("LEAST_PROMISE", "NOISY_LEAST_PROMISE"):
        monkeypatch.setattr(f"ocp_torch.certificate.lower.sampled.{least}", 0.0)
    problem = zoo.build(name)
    value = perturbed(problem)
    weights = copy.deepcopy(value.state_dict())
    sets = replicated_samples(problem, 1024, 8, seed=0, divergences=False)
    found = SampledValue(problem, value, sets, ascents=8, search=True)
    lost = problem.exact_optimum - found.own.bound, problem.exact_optimum - found.best.bound
    assert lost[1] < 0.8 * lost[0]
    assert lost[1] > -6.0 * found.best.estimate.se - 1e-9
    assert "tightened" in found.best.sentence
    assert all(torch.equal(tensor, weights[key]) for key, tensor in value.state_dict().items())  # the controller's


def test_what_cannot_be_trained_on_stays_as_it_is():
    trained = lambda value, **how: tightened(Circle(), value, seed=0, **how)
    assert trained(Circle().exact_value) is None
    assert trained(perturbed(Circle()), steps=0) is None
    broken = perturbed(Circle())
    broken.head.bias.fill_(math.nan)
    assert trained(broken) is None


def test_a_quick_certificate_trains_for_as_many_times_fewer_steps_as_it_has_fewer_states(monkeypatch):
    monkeypatch.setattr("ocp_torch.certificate.lower.tightened.PLAN", (1000.0, 24, 1e-3))
    monkeypatch.setattr("ocp_torch.certificate.lower.tightened.BATCH", 64)
    steps = []
    advance = "ocp_torch.certificate.lower.tightened.advance"
    monkeypatch.setattr(advance, lambda *how: (steps.append(how), fitting.advance(*how)))

    def count(*how) -> int:
        steps.clear()
        tightened(Circle(), perturbed(Circle()), 0, *how)
        return len(steps)

    assert [count(batch) for batch in (1000, 64, 16, 1)] == [24, 24, 6, 1]
    assert [count(batch, 48) for batch in (64, 16)] == [48, 12]


class AsIfNoisy(Circle):
    """The circle, taken for one with noise where it is asked whether there is any."""

    noisy = True


# Heights of spikes on the exact `V` before and after; the optimum is .06.
@pytest.mark.parametrize(
    ("problem", "heights", "trained", "best"),
    [
        (AsIfNoisy(), (6e-4, 0.0), True, 0.0),
        (AsIfNoisy(), (2e-4, 0.0), False, 2e-4),  # a third of one per cent is little
        (Circle(), (0.02, 0.01), True, 0.01),
        (Circle(), (0.02, 0.03), True, 0.02),
        (Circle(), (2e-4, 0.0), True, 0.0),  # a third of one per cent is much
        (Circle(), (1e-5, 0.0), False, 1e-5),
    ],
)
def test_v_is_trained_on_where_there_is_enough_to_gain(problem, heights, trained, best, monkeypatch):
    exact = Circle()
    grid = torch.linspace(0.0, 1.0, 1001, dtype=torch.float64).unsqueeze(1)
    place = float(grid[exact.state_cost(grid).argmin()])  # where no multiple of V makes up for it
    spike = lambda x: torch.where((x[:, 0] - place).abs() < 1e-3, 1.0, 0.0)

    class Spiked(torch.nn.Module):
        def __init__(self, height):
            super().__init__()
            self.height = torch.nn.Parameter(torch.tensor(height, dtype=torch.float64))

        def forward(self, x):
            return exact.exact_value(x) + self.height * spike(x)

    sets = replicated_samples(problem, 2048, 2, 0, divergences=False)
    V, W = (Spiked(h) for h in heights)
    asked = []

    def training(*_):
        asked.append(W)
        return Subsolution(W, sets[0].x[:4])

    monkeypatch.setattr("ocp_torch.certificate.lower.sampled.tightened", training)
    monkeypatch.setattr("ocp_torch.certificate.lower.sampled.mollified_shift", lambda best: best)
    found = SampledValue(problem, V, sets, ascents=2, search=True)
    lost = exact.exact_optimum - found.own.bound
    # The mean of the tail has a part of the spike.
    assert attainable(found.own) - found.own.bound == pytest.approx(lost, rel=0.4, abs=1e-4)
    assert found.best.value.height.item() == best
    assert asked == ([W] if trained else [])
    # Its supremum is sought at the states that training found worst, too.
    assert len(found.best.beside) == (found.best.value is not V)
    # And it is kept, where the bound is of it.
    assert (found.subsolution is None) == (found.best.value is V)
