"""Waves found in data: all that are planted, none that are not; and integrals that lose their noise without bias."""

import math
from functools import partial
from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.certificate.statistics.estimate import integrals
from ocp_torch.fields import CONTROL_DENSITY, VALUE, Fields, PeriodicMLP
from ocp_torch.fields.coupled_waves import coupled_waves
from ocp_torch.fields.waves import prominent_waves
from ocp_torch.maths.jets import jet
from ocp_torch.maths.sampling import evaluation_points
from ocp_torch.problems import Manufactured, Problem, Torus
from ocp_torch.problems.samples import Samples

TURN = 2.0 * math.pi


class Planted(Problem):
    """`f = 3 + sum_j cos(2 pi k_j . x + j)` with the given waves."""

    def __init__(self, waves: torch.Tensor) -> None:
        super().__init__(waves.shape[1])
        self.waves = waves

    def state_cost(self, x):
        angles = TURN * (x @ self.waves.to(x).T) + torch.arange(len(self.waves)).to(x)
        return 3.0 + angles.cos().sum(dim=-1)


def found_in(problem: Problem, count: int = 32) -> set[tuple]:
    x = torch.rand(8192, problem.dim, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    waves = prominent_waves(Samples.of(problem, x, divergences=False), count)
    return {tuple(k) for k in waves.tolist()} | {tuple(-e for e in k) for k in waves.tolist()}


@st.composite
def interactions(draw):
    """Up to four waves in two to eight dimensions with two or more entries, and a few single coordinates."""
    dim = draw(st.integers(2, 8))
    entry = st.sampled_from([-2.0, -1.0, 0.0, 1.0, 2.0])
    wave = st.lists(entry, min_size=dim, max_size=dim).filter(lambda k: sum(e != 0 for e in k) >= 2)
    return torch.tensor(draw(st.lists(wave, min_size=1, max_size=4)))


@pytest.mark.nightly
@given(interactions())
@settings(max_examples=12, deadline=None)
def test_every_planted_wave_is_found(waves):
    found = found_in(Planted(waves))
    assert {tuple(k) for k in waves.tolist()} <= found
    assert len(found) == 2 * len({tuple(max(k, [-e for e in k])) for k in waves.tolist()})


@pytest.mark.parametrize("dim", [16, 40])
def test_pairs_are_found_in_many_dimensions(dim):
    waves = torch.zeros(3, dim)
    waves[0, 0], waves[0, dim - 1] = 1.0, -2.0
    waves[1, 3], waves[1, 7] = 1.0, 1.0
    waves[2, 5], waves[2, dim // 2] = 2.0, 1.0
    assert {tuple(k) for k in waves.tolist()} <= found_in(Planted(waves))


def coupled_in(function, dim, known=()):
    x = torch.rand(8192, dim, generator=torch.Generator().manual_seed(1))
    return coupled_waves(function, x, torch.tensor([*torch.eye(dim).tolist(), *known]), 32)


def test_waves_of_many_coordinates_are_found_in_many_dimensions():
    """More than lists of candidates hold, small ones beside large ones too, and each once."""
    waves = torch.zeros(4, 14)
    waves[0, [0, 2, 5, 7, 13]] = torch.tensor([1.0, -1.0, 2.0, 1.0, -2.0])
    waves[1] = 1.0
    waves[2, [1, 2, 3, 4]] = torch.tensor([2.0, 1.0, 1.0, -1.0])
    waves[3, [6, 8, 9, 10, 11, 12]] = -1.0
    wanted = {tuple(wave) for wave in [*waves[:3].tolist(), (-waves[3]).tolist()]}
    sizes = torch.tensor([1.0, 0.7, 1.0, 0.2])
    function = lambda x: 3.0 + (TURN * (x @ waves.T)).cos() @ sizes + (TURN * x[:, 0]).sin()
    found = coupled_in(function, 14).tolist()
    assert {tuple(wave) for wave in found} == wanted
    assert len(found) == 4
    assert len(coupled_in(function, 14, waves[:3].tolist())) == 0  # what is left is not worth it
    assert wanted - {tuple(wave) for wave in found_in(Planted(waves))}  # lists do not hold them


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_nothing_is_found_where_single_coordinates_make_all(size):
    assert len(coupled_in(lambda x: 1.0 + size * (TURN * x).cos().sum(dim=-1), 10)) == 0


def test_all_waves_of_a_parity_are_found_and_nothing_in_noise():
    """`sign sin 2 pi x_1 .. sign sin 2 pi x_6`: 32 waves of six coordinates of the same size."""
    found = coupled_in(lambda x: 2.0 - (TURN * x[:, :6]).sin().sign().prod(dim=-1), 9)
    assert {tuple(wave) for wave in found.tolist()} == {
        (1.0, *rest, 0.0, 0.0, 0.0) for rest in product((1.0, -1.0), repeat=5)
    }
    noise = torch.Generator().manual_seed(0)
    assert len(coupled_in(lambda x: torch.randn(len(x), generator=noise), 9)) == 0


@pytest.mark.parametrize("odd", [math.nan, math.inf])
def test_a_cost_that_is_not_finite_has_no_waves(odd):
    assert len(coupled_in(lambda x: torch.where(x[:, 0] > 0.999, odd, (TURN * x[:, 1]).cos()), 9)) == 0


class Asked(Planted):
    """Says how many states its cost was asked at."""

    concurrent, asked = True, 0

    def state_cost(self, x):
        self.asked += len(x)
        return super().state_cost(x)


class OneByOne(Asked):
    """As a simulator that takes one state at a time."""

    concurrent, scan_factor = False, 0


@pytest.mark.nightly
def test_networks_get_them_where_states_cost_little():
    waves = torch.tensor([[1.0, -1.0, 1.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0]])
    problem, dear = Asked(waves), OneByOne(waves)
    network = partial(PeriodicMLP, width=8, modes=1, waves=4)
    assert Fields.build(problem, (VALUE,), network, 0).value.embedding.mixed.tolist() == [
        *waves.tolist(),
        *[[0.0] * 10] * 3,
    ]
    assert not Fields.build(dear, (VALUE,), network, 0).value.embedding.mixed.any()
    assert dear.asked < problem.asked


def test_nothing_is_found_where_coordinates_do_not_interact():
    assert found_in(Planted(torch.eye(5))) == set()
    assert found_in(Flat(4)) == set()


class Flat(Problem):
    def state_cost(self, x):
        return torch.ones_like(x[:, 0])


@pytest.mark.nightly
def test_what_the_drift_and_the_controls_couple_counts_as_well():
    problem = Manufactured(dim=6, interaction=5, seed=3)
    assert {tuple(k) for k in problem.V0.waves.tolist()} <= found_in(problem, 64)
    assert (0.0, 1.0, 1.0) in found_in(Torus(3))


def test_networks_get_the_waves_keep_them_and_stay_periodic():
    problem = Torus(2)
    network = partial(PeriodicMLP, width=16, modes=2, waves=4)
    fields = Fields.build(problem, (VALUE, CONTROL_DENSITY), network, 0).double()
    assert fields.value.embedding.mixed[0].tolist() == [1.0, 1.0]
    assert fields.control_density.embedding.mixed[1].tolist() == [2.0, 2.0]
    again = Fields({VALUE: network(2), CONTROL_DENSITY: network(2, outputs=2)}).double()
    again.load_state_dict(fields.state_dict())
    x = torch.randint(2**10, (100, 2), generator=torch.Generator().manual_seed(0)).double() / 2**10
    for shift in (0.0, 1.0, -7.0):
        moved, kept = jet(again.value, x + shift), jet(fields.value, x)
        for one, other in ((moved.value, kept.value), (moved.gradient, kept.gradient)):
            assert torch.equal(one, other)


def polynomial(x):
    """Mean 2, with waves of one, two and six coordinates."""
    return 2.0 + (TURN * (x[:, 0] - 2.0 * x[:, 3])).cos() + (TURN * x.sum(dim=-1)).sin() + 0.5 * (TURN * x[:, 1]).cos()


def test_integrals_of_waves_are_exact():
    states = [evaluation_points(1024, 6, r, 0) for r in range(8)]
    for mean in integrals(states, [polynomial(x) for x in states]):
        assert mean == pytest.approx(2.0, abs=1e-9)


def test_no_set_is_corrected_by_a_fit_to_its_own_half():
    """More of a wave in the first set changes what is taken off the second and the fourth, and not off the third."""
    draw = torch.Generator().manual_seed(0)
    states = [torch.rand(512, 6, generator=draw, dtype=torch.float64) for _ in range(4)]
    values = [polynomial(x) + 0.3 * torch.randn(512, generator=draw, dtype=torch.float64) for x in states]
    more = [values[0] + 1e-3 * (TURN * states[0][:, 1]).cos(), *values[1:]]
    change = [b - a for a, b in zip(integrals(states, values), integrals(states, more), strict=True)]
    assert abs(change[2]) < 1e-11
    assert min(abs(change[1]), abs(change[3])) > 1e-8


@pytest.mark.nightly
def test_what_the_fit_takes_off_has_mean_zero():
    """`exp` of a polynomial is no polynomial: repeated estimates scatter about the mean that one large sample gives."""
    g = lambda x: polynomial(x).exp()
    truth = g(evaluation_points(2**20, 6, 0, 99)).mean()
    repeated = []
    for seed in range(40):
        states = [evaluation_points(256, 6, r, seed) for r in range(8)]
        repeated.append(sum(integrals(states, [g(x) for x in states])) / 8)
    found = torch.tensor(repeated, dtype=torch.float64)
    assert abs(found.mean() - truth) < 4.0 * found.std() / math.sqrt(40)
    plain = torch.tensor(
        [float(g(torch.cat([evaluation_points(256, 6, r, s) for r in range(8)])).mean()) for s in range(40)]
    )
    assert found.std() < 0.5 * plain.std()


def test_in_two_coordinates_the_noise_of_sobol_sets_goes_too():
    f = Manufactured().state_cost
    states = [evaluation_points(2048, 2, r, 0) for r in range(16)]
    values = [f(x) for x in states]
    plain, found = torch.stack([v.mean() for v in values]), torch.tensor(integrals(states, values), dtype=torch.float64)
    truth = float(f(evaluation_points(2**18, 2, 0, 1)).mean())
    assert float(found.std()) < 0.3 * float(plain.std())
    assert abs(float(found.mean()) - truth) < 4.0 * float(found.std()) / 4.0


def test_a_single_set_is_averaged_as_it_is():
    x = evaluation_points(512, 2, 0, 0)
    values = Manufactured().state_cost(x)
    assert integrals([x], [values]) == [float(values.mean())]
