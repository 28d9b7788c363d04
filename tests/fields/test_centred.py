"""Features about a state of rest: the rise of `V` can be read from them, and a network with them is as any other."""

import pytest
import torch

from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.fields.centred import LEVELS, Centred
from ocp_torch.fields.logarithmic import Logarithmic
from ocp_torch.maths.jets import jet, reverse_jet
from ocp_torch.problems import PROBLEMS
from ocp_torch.problems.equilibrium import equilibrium


def centred(dim: int = 3, unit: float = 0.1) -> tuple[Centred, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    at, root = (torch.rand(*shape, dtype=torch.float64, generator=generator) for shape in ((dim,), (dim, dim)))
    features = Centred(dim).double()
    features.centre(at, 40.0 * root @ root.T, unit)
    return features, at, 40.0 * root @ root.T


def test_the_quadratic_rise_can_be_read_from_them():
    features, at, bend = centred()
    y = 1e-5 * torch.randn(50, 3, dtype=torch.float64)
    rise = 0.5 * torch.einsum("ni,ij,nj->n", y, bend, y) / 0.1
    for level, found in zip(LEVELS, features(at + y + 2.0).chunk(len(LEVELS), dim=-1), strict=True):
        squares = level * found.square() / (1.0 - found.square())
        torch.testing.assert_close(squares.sum(dim=-1), rise, rtol=1e-6, atol=0.0)


def test_they_are_bounded_and_periodic_and_nothing_before_there_is_a_state_of_rest():
    features, *_ = centred()
    x = torch.rand(100, 3, dtype=torch.float64)
    torch.testing.assert_close(features(x + 1.0), features(x))
    assert float(features(x).abs().max()) < 1.0
    assert float(Centred(3)(x.float()).abs().max()) == 0.0


def test_a_direction_in_which_nothing_is_gained_adds_nothing():
    features = Centred(2).double()
    features.centre(torch.zeros(2).double(), torch.diag(torch.tensor([4.0, -1e-12])).double(), 1.0)
    x = torch.rand(20, 2, dtype=torch.float64)
    moved = x + torch.tensor([0.0, 0.3], dtype=torch.float64)
    torch.testing.assert_close(features(moved), features(x))


@pytest.mark.parametrize("columns", [None, 1, 3])
def test_a_jet_is_that_of_reverse_passes(columns):
    with torch.random.fork_rng():
        torch.manual_seed(1)
        network = Logarithmic.of(PeriodicMLP, dim=3, width=16, activation="tanh").double()
    features, at, bend = centred()
    network.logarithm.centred.centre(at, bend, 0.1)
    x = torch.rand(32, 3, dtype=torch.float64)
    sigma = None if columns is None else torch.randn(32, 3, columns, dtype=torch.float64)
    own, nested = jet(network, x, sigma), reverse_jet(network, x, sigma)
    for part in ("value", "gradient") if columns is None else ("value", "gradient", "curvature"):
        torch.testing.assert_close(getattr(own, part), getattr(nested, part), rtol=1e-11, atol=1e-11)


def test_only_the_value_of_a_warm_start_has_them():
    problem = PROBLEMS["pendulum"]()
    fields = Fields.build(problem, ("value", "trajectory_value"), PeriodicMLP, 0)
    assert fields.value.centred is None
    own = fields.trajectory_value.logarithm.centred
    torch.testing.assert_close(own.at.double(), equilibrium(problem).at)
    assert float(own.root.abs().max()) > 0.0
    lost = Fields.build(PROBLEMS["dubins"](), ("trajectory_value",), PeriodicMLP, 0).trajectory_value.logarithm.centred
    assert float(lost.root.abs().max()) == 0.0
