"""Networks in single precision for states in double precision."""

import pytest
import torch

from ocp_torch.fields import PeriodicMLP, SobolevField
from ocp_torch.fields.rounded import Rounded
from ocp_torch.maths.jets import curvature, jet


def made(kind):
    with torch.random.fork_rng():
        torch.manual_seed(4)
        if kind == "sobolev":
            network = SobolevField(2, regularity=3.0, modes=2).double()
            torch.nn.init.normal_(network.coefficients)
        else:
            network = PeriodicMLP(2, gated=kind == "gated", shift=3.0, scale=2.0).double()
    return network.requires_grad_(False)


@pytest.mark.parametrize("noisy", [False, True])
@pytest.mark.parametrize("kind", ["plain", "gated", "sobolev"])
def test_it_is_off_by_rounding_alone_far_from_the_unit_cell_too(kind, noisy):
    network, generator = made(kind), torch.Generator().manual_seed(0)
    x = torch.rand(200, 2, dtype=torch.float64, generator=generator)
    away = x + torch.randint(-(10**6), 10**6, x.shape, generator=generator)
    sigma = torch.rand(200, 2, 2, dtype=torch.float64, generator=generator) if noisy else None
    exact, found = jet(network, x, sigma), jet(Rounded(network), away, sigma)
    assert found.value.dtype == torch.float64
    torch.testing.assert_close(Rounded(network)(away), exact.value, rtol=1e-5, atol=1e-5)
    for name in ("value", "gradient") + noisy * ("curvature",):
        size = float(getattr(exact, name).detach().abs().max())
        torch.testing.assert_close(getattr(found, name), getattr(exact, name), rtol=0.0, atol=1e-5 * size)
    if sigma is not None:
        bent, size = curvature(Rounded(network), away, sigma), float(exact.curvature.detach().abs().max())
        torch.testing.assert_close(bent, exact.curvature, rtol=0.0, atol=1e-5 * size)
    assert next(iter(network.state_dict().values())).dtype == torch.float64  # its own weights are left alone
