"""Networks on the torus: exactly periodic, smooth at the wrap, drawn from their seed alone, in the problem's units."""

import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.fields import CONTROL_DENSITY, LOG_OCCUPATION, VALUE, Fields, PeriodicMLP
from ocp_torch.maths.jets import jet
from ocp_torch.problems import Circle, Problem
from support import zoo

NAMES = (VALUE, CONTROL_DENSITY, LOG_OCCUPATION)


def seeded(seed: int, *arguments, **options) -> PeriodicMLP:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return PeriodicMLP(*arguments, **options)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dim", [1, 3])
def test_a_network_is_bitwise_periodic_in_value_and_gradient(dim, dtype, device):
    """Multiples of 2^-10 are exact in float32 also after shifts by whole numbers up to 2^13."""
    network = seeded(0, dim, modes=4).to(device, dtype)
    x = torch.randint(2**10, (200, dim), generator=torch.Generator().manual_seed(0)).to(device, dtype) / 2**10
    sigma = torch.randn(200, dim, dim, generator=torch.Generator().manual_seed(1)).to(device, dtype)
    reference = vars(jet(network, x, sigma)).values()
    for shift in (1.0, -1.0, -7.0, 2.0**13):
        for coordinate in range(dim):
            moved = x.clone()
            moved[:, coordinate] += shift
            for found, expected in zip(vars(jet(network, moved, sigma)).values(), reference, strict=True):
                assert torch.equal(found, expected)


def test_a_network_made_in_single_precision_is_smooth_at_the_wrap_once_it_is_double():
    """Wave numbers rounded in float32 would leave a jump of about 1e-7; second derivatives are of order 100."""
    network = seeded(1, 1, modes=6).double()
    left, right = torch.tensor([[1.0 - 1e-12]], dtype=torch.float64), torch.tensor([[0.0]], dtype=torch.float64)
    sigma = torch.ones(1, 1, 1, dtype=torch.float64)
    ends = [vars(jet(network, x, sigma)).values() for x in (left, right)]
    for at_one, at_zero in zip(*ends, strict=True):
        torch.testing.assert_close(at_one, at_zero, rtol=0.0, atol=1e-9)


def test_the_field_has_no_wider_symmetry_than_the_period():
    """A network that was constant or of period one half would pass every test above."""
    network, x = seeded(0, 2), zoo.states(Problem(2), 100, dtype=torch.float32)
    for shift in ([0.5, 0.0], [0.0, 0.5], [1.0 / 3.0, 1.0 / 3.0]):
        assert (network(x + torch.tensor(shift)) - network(x)).abs().max() > 1e-3


@pytest.mark.parametrize(("outputs", "shape"), [(None, (5,)), (1, (5, 1)), (3, (5, 3))])
def test_outputs_have_the_documented_shape(outputs, shape):
    assert seeded(0, 2, outputs)(torch.zeros(5, 2)).shape == shape


def test_the_seed_alone_decides_the_initial_parameters():
    problem = Circle()
    before = torch.random.get_rng_state()
    first = Fields.build(problem, NAMES, PeriodicMLP, seed=3)
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.manual_seed(99)
    again, other = (Fields.build(problem, NAMES, PeriodicMLP, seed=s) for s in (3, 4))
    same = [torch.equal(p, r) for p, r in zip(first.parameters(), again.parameters(), strict=True)]
    assert all(same)
    assert not torch.equal(first.value.body[0].weight, other.value.body[0].weight)
    assert not torch.equal(first.value.body[0].weight, first.log_occupation.body[0].weight)


def test_fields_read_by_name_and_what_is_absent_reads_as_none():
    fields = Fields.build(zoo.Swing(), (VALUE, CONTROL_DENSITY), PeriodicMLP, seed=0)
    x = torch.zeros(4, 2)
    assert fields.value(x).shape == (4,)
    assert fields.control_density(x).shape == (4, 1)
    assert fields.log_occupation is None
    assert fields.parameters_of([CONTROL_DENSITY]) == list(fields.control_density.parameters())
    assert len(fields.parameters_of([VALUE, CONTROL_DENSITY])) == len(list(fields.parameters()))


class InOtherUnits(zoo.Swing):
    """The same cost in a unit ``unit`` times smaller, measured from another zero."""

    def __init__(self, unit: float, zero: float) -> None:
        super().__init__()
        self.unit, self.zero = unit, zero

    def state_cost(self, x):
        return self.unit * super().state_cost(x) + self.zero


def test_fields_start_in_the_units_of_the_problem():
    """A cost `k f + c` gives the value `k V + c`, controls `k^{1/q}` as large, and the same density."""
    build = lambda problem: Fields.build(problem, NAMES, PeriodicMLP, seed=0)
    k, c, q = 1e4, 5.0, 1.5
    plain, scaled = build(zoo.Swing()), build(InOtherUnits(k, c))
    x = zoo.states(zoo.Swing(), 100, dtype=torch.float32)
    torch.testing.assert_close(scaled.value(x), k * plain.value(x) + c, rtol=1e-5, atol=1e-2)
    torch.testing.assert_close(
        scaled.control_density(x), k ** (1.0 / q) * plain.control_density(x), rtol=1e-5, atol=1e-5
    )
    assert torch.equal(scaled.log_occupation(x), plain.log_occupation(x))


def test_the_value_starts_near_the_mean_state_cost_and_the_density_near_one():
    fields = Fields.build(zoo.Swing(), NAMES, PeriodicMLP, seed=0)
    x = zoo.states(zoo.Swing(), 500, dtype=torch.float32)
    # The mean state cost is 1, its standard deviation 1/2; the last layer starts ten times smaller than the others.
    assert (fields.value(x) - 1.0).abs().max() < 0.25
    assert fields.log_occupation(x).abs().max() < 0.5


def test_a_constant_state_cost_still_gives_a_scale():
    flat = type("Flat", (Problem,), {"state_cost": lambda self, x: torch.full_like(x[:, 0], 3.0)})(dim=2)
    fields = Fields.build(flat, NAMES, PeriodicMLP, seed=0)
    assert float(fields.value.scale) == pytest.approx(3.0)
    assert float(fields.control_density.scale) > 0.0


@pytest.mark.parametrize(
    ("cost", "message"),
    [(lambda self, x: 1.0 / (x[:, 0] * 0.0), "not finite"), (lambda self, x: x[:, :1], "shape")],
    ids=["infinite", "wrong shape"],
)
def test_a_state_cost_that_cannot_be_used_is_refused(cost, message):
    bad = type("Bad", (Problem,), {"state_cost": cost})(dim=2)
    with pytest.raises(InputError, match=message):
        Fields.build(bad, NAMES, PeriodicMLP, seed=0)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        (dict(modes=0), "model.modes"),
        (dict(width=0), "model.width"),
        (dict(depth=0), "model.depth"),
        (dict(activation="relu"), "model.activation"),
    ],
)
def test_a_wrong_option_of_the_network_is_refused_by_name(options, field):
    with pytest.raises(InputError, match=field):
        PeriodicMLP(2, **options)
