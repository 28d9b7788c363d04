"""The network of a logarithm: its derivatives are those of what it gives, and it starts in the units of the problem."""

import pytest
import torch

from ocp_torch.fields import PeriodicMLP
from ocp_torch.fields.logarithmic import Logarithmic
from ocp_torch.maths.jets import jet, reverse_jet


@pytest.mark.parametrize("columns", [None, 1, 3])
def test_a_jet_is_that_of_reverse_passes(columns):
    with torch.random.fork_rng():
        torch.manual_seed(1)
        network = Logarithmic(PeriodicMLP(3, width=16, activation="tanh"), 0.3).double()
    x = torch.rand(32, 3, dtype=torch.float64)
    sigma = None if columns is None else torch.randn(32, 3, columns, dtype=torch.float64)
    own, nested = jet(network, x, sigma), reverse_jet(network, x, sigma)
    parts = ("value", "gradient") if columns is None else ("value", "gradient", "curvature")
    for part in parts:
        torch.testing.assert_close(getattr(own, part), getattr(nested, part), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("shift", "scale"), [(0.0, 1.0), (2.5, 0.4), (1e-6, 1e-7), (300.0, 80.0)])
def test_it_starts_near_the_shift(shift, scale):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = Logarithmic.of(PeriodicMLP, shift=shift, scale=scale, dim=2)
    values = network(torch.rand(256, 2))
    assert float((values - shift).abs().max()) < 0.5 * (shift + scale)
