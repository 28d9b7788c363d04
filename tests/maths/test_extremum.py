"""The search for suprema: finds known ones, never claims more than there is, and never hides a NaN."""

import math

import pytest
import torch

from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.supremum import batched, peaks_in_reach, supremum
from support.hidden_peak import HILLS, hidden_peak, top

TURN = 2.0 * math.pi
each_dimension = pytest.mark.parametrize("dim", [1, 2, 4])


def bumpy(dim: int):
    """A function with local maxima between 0 and its supremum, which is exactly 1, and where that is."""
    peak = torch.linspace(0.113, 0.871, dim, dtype=torch.float64)

    def function(x):
        angle = TURN * (x - peak.to(x))
        return (0.7 * angle.cos() + 0.2 * (2.0 * angle).cos() + 0.1 * (3.0 * angle).cos()).mean(dim=-1)

    return function, peak


def points(dim, count=2048):
    return scrambled_sobol(count, dim, 0, torch.float64)


@each_dimension
def test_finds_a_known_maximum_to_a_millionth_and_says_where(dim):
    function, peak = bumpy(dim)
    found = supremum(function, points(dim))
    assert 1.0 - 1e-6 <= found.value <= 1.0 + 1e-12
    torch.testing.assert_close(found.x, peak, rtol=0.0, atol=1e-3)
    assert (found.points, found.ascents) == (2048, 32)


@each_dimension
def test_climbs_well_above_what_was_sampled(dim):
    function, _ = bumpy(dim)
    sampled = float(function(points(dim, 64)).max())
    assert 1.0 - supremum(function, points(dim, 64)).value < 0.01 * (1.0 - sampled)


@each_dimension
@pytest.mark.parametrize("differentiable", [True, False])
def test_is_never_below_what_was_sampled_nor_above_the_truth(dim, differentiable):
    function, _ = bumpy(dim)
    for count in (1, 5, 300):
        x = points(dim, count)
        found = supremum(function, x, differentiable=differentiable).value
        assert float(function(x).max()) <= found <= 1.0 + 1e-12


def test_random_directions_serve_where_there_is_no_gradient():
    function, _ = bumpy(2)
    blind = lambda x: function(x.detach())
    assert supremum(blind, points(2), differentiable=False).value >= 1.0 - 1e-4


def test_finds_a_maximum_at_a_kink():
    """`-|x - p|_1` on the torus: the gradient never vanishes."""
    distance = lambda x: ((x - 0.3).remainder(1.0) - 0.5).abs().sum(dim=-1) - 1.0
    found = supremum(lambda x: distance(x), points(2)).value
    assert -1e-3 <= found <= 1e-12


def test_the_place_it_reports_has_the_value_it_reports_and_lies_on_the_torus():
    function, _ = bumpy(3)
    found = supremum(lambda x: function(x), 1.0 - 1e-3 * points(3, 50))
    assert ((found.x >= 0.0) & (found.x < 1.0)).all()
    assert float(function(found.x.unsqueeze(0))) == pytest.approx(found.value, abs=1e-12)


@pytest.mark.parametrize("differentiable", [True, False])
def test_a_nan_at_a_sampled_state_is_returned_as_nan(differentiable):
    x = points(2)
    hole = x[1234]
    function = lambda y: torch.where((y == hole).all(dim=-1), math.nan, y.sin().sum(dim=-1))
    assert math.isnan(supremum(function, x, differentiable=differentiable).value)


def test_a_nan_met_on_the_way_up_is_returned_as_nan():
    """No sampled state is inside the hole around the maximum, but every ascent runs into it."""
    function, peak = bumpy(1)
    holed = lambda x: torch.where((x - peak).abs().amax(dim=-1) < 0.02, math.nan, function(x))
    outside = points(1)
    outside = outside[((outside - peak).abs() >= 0.02).all(dim=-1)]
    assert math.isnan(supremum(holed, outside).value)


def test_an_infinite_value_is_the_supremum():
    function = lambda x: torch.where(x[:, 0] == 0.5, math.inf, x.sum(dim=-1))
    x = torch.cat([points(2, 100), torch.tensor([[0.5, 0.1]], dtype=torch.float64)])
    assert supremum(function, x).value == math.inf


@pytest.mark.parametrize("chunk", [1, 7, 100, 1000])
def test_batches_of_any_size_give_the_same_values(chunk):
    function, _ = bumpy(2)
    assert torch.equal(batched(function, points(2, 100), chunk), function(points(2, 100)))


@pytest.mark.parametrize("seed", [0, 2, 3, 4])
def test_a_peak_in_a_hollow_is_found_from_steep_places_alone(seed):
    x = scrambled_sobol(32768, 2, seed, torch.float64)
    assert supremum(hidden_peak, x).value < 1.001 * HILLS
    ends, values = peaks_in_reach(hidden_peak, x, 2048)
    assert float(values.max()) == pytest.approx(top(), rel=1e-4)
    torch.testing.assert_close(hidden_peak(ends), values)
    assert bool(((ends >= 0.0) & (ends < 1.0)).all())


@pytest.mark.parametrize("count", [1, 3, 100])
def test_few_points_are_as_many_starts_as_there_can_be(count):
    x = points(2, count)
    ends, values = peaks_in_reach(bumpy(2)[0], x, 1000)
    assert 1 <= len(ends) == len(values) <= count
    assert float(values.max()) >= float(bumpy(2)[0](x).max())
    assert math.isnan(float(peaks_in_reach(lambda at: at[:, 0] * math.nan, x, 1000)[1].max()))
