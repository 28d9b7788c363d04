"""Derivatives of networks and divergences of problems against central finite differences in float64."""

import pytest
import torch

from ocp_torch.fields import PeriodicMLP
from ocp_torch.maths import jets
from ocp_torch.problems.samples import Samples
from support import zoo

# A step of 1e-5 leaves h^2 = 1e-10 times third derivatives (of order 1e3 here), and rounding of 1e-16 / 1e-5.
STEP, TOLERANCE = 1e-5, dict(rtol=1e-6, atol=1e-6)
N = 64


def along(field, x, direction, h=STEP):
    """The derivative of ``field`` along each row of ``direction``, by central differences."""
    return (field(x + h * direction) - field(x - h * direction)) / (2.0 * h)


def partials(field, x):
    """All first derivatives, with the coordinate as last axis."""
    return torch.stack([along(field, x, e.expand_as(x)) for e in torch.eye(x.shape[1], dtype=x.dtype).to(x)], dim=-1)


def uniform(d, seed=0, device="cpu", dtype=torch.float64):
    return torch.rand(N, d, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(device, dtype)


@pytest.mark.parametrize("d", [1, 2, 5])
def test_value_and_gradient_of_a_network(d, device):
    network, x = zoo.rough_network(d, seed=d).to(device), uniform(d, device=device)
    V = jets.jet(network, x)
    # Layer by layer, in another order of operations than PyTorch's modules: the last digits differ.
    torch.testing.assert_close(V.value, network(x), rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(V.gradient, partials(network, x), **TOLERANCE)


@pytest.mark.parametrize("outputs", [1, 3])
def test_value_and_jacobian_of_a_network(outputs, device):
    network, x = zoo.rough_network(2, seed=1, outputs=outputs).to(device), uniform(2, device=device)
    value, jacobian = jets.value_and_jacobian(network, x)
    torch.testing.assert_close(value, network(x))
    torch.testing.assert_close(jacobian.movedim(0, 1), partials(network, x), **TOLERANCE)


@pytest.mark.parametrize("d", [1, 3])
def test_divergence_of_a_network(d, device):
    network, x = zoo.rough_network(d, seed=2, outputs=d).to(device), uniform(d, device=device)
    expected = partials(network, x).diagonal(dim1=1, dim2=2).sum(dim=-1)
    torch.testing.assert_close(jets.divergence(network, x), expected, **TOLERANCE)


@zoo.on(("circle rho=2", "torus 3-d random", "manufactured 3-d m=2 B(x) q=1.5", "swing"))
def test_control_flux_divergence_is_that_of_the_whole_product(problem, device):
    """`div(B w)` differenced as one vector field, product rule and all."""
    network = zoo.rough_network(problem.dim, seed=3, outputs=problem.control_dim).to(device)
    x = zoo.states(problem, N).to(device)
    flux = lambda y: torch.einsum("ndm,nm->nd", problem.control_matrix(y), network(y))
    w, found = jets.control_flux_divergence(network, x, problem.control_matrix(x), problem.control_divergence(x))
    torch.testing.assert_close(w, network(x))
    torch.testing.assert_close(found, partials(flux, x).diagonal(dim1=1, dim2=2).sum(dim=-1), **TOLERANCE)


def test_everything_is_differentiable_again_in_the_parameters(device):
    """The slope in the last layer's weights of a number that uses all four functions."""
    network = zoo.rough_network(2, seed=4, outputs=2).to(device)
    x, B = uniform(2, device=device), uniform(4, device=device).reshape(N, 2, 2)
    first = lambda y: network(y)[:, 0]

    def number():
        V = jets.jet(first, x)
        _, flux = jets.control_flux_divergence(network, x, B, torch.ones_like(x))
        squares = [
            V.gradient.square().sum(-1),
            (V.gradient * x).sum(-1) ** 2,
            flux**2,
            jets.divergence(network, x) ** 2,
        ]
        return (V.value + sum(squares)).mean()

    for weight in (network.head.weight, network.body[0].weight):
        weight.requires_grad_(True)
        (slope,) = torch.autograd.grad(number(), weight)
        weight.requires_grad_(False)
        direction = torch.ones_like(weight)
        ends = []
        for sign in (1.0, -1.0):
            weight += sign * STEP * direction
            ends.append(number())
            weight -= sign * STEP * direction
        torch.testing.assert_close((slope * direction).sum(), (ends[0] - ends[1]) / (2.0 * STEP), rtol=1e-5, atol=1e-5)


@zoo.on(zoo.ALL)
def test_divergences_of_the_problem_are_those_of_finite_differences(problem):
    x = zoo.states(problem, N, off_kinks=True)
    expected = partials(problem.drift, x).diagonal(dim1=1, dim2=2).sum(dim=-1)
    # Where q' - 2 is near 0 or B^T grad V is near 0 the optimal control has large second derivatives.
    torch.testing.assert_close(problem.drift_divergence(x), expected, rtol=1e-5, atol=1e-5)
    columns = partials(problem.control_matrix, x)
    torch.testing.assert_close(problem.control_divergence(x), torch.einsum("nimi->nm", columns), **TOLERANCE)


@pytest.mark.parametrize("name", zoo.spread(zoo.ALL))
def test_single_precision_stays_single_and_agrees_with_double(name, device):
    """Also when its very first evaluation is inside a derivative."""
    problem = zoo.fresh(name)
    x = zoo.states(problem, N, off_kinks=True).to(device, torch.float32)
    div_a, div_B = problem.drift_divergence(x), problem.control_divergence(x)
    single, double = Samples.of(problem, x), Samples.of(problem, x.double())
    assert torch.equal(single.div_a, div_a)
    assert torch.equal(single.div_B, div_B)
    for field in ("f", "a", "B", "mu0", "div_a", "div_B"):
        found, exact = getattr(single, field), getattr(double, field)
        assert found.dtype == torch.float32
        assert found.device == x.device
        # Derivatives of frequencies up to 6 amplify the rounding of 2 pi k x.
        torch.testing.assert_close(found.double(), exact, rtol=2e-4, atol=2e-4)


def test_derivatives_of_a_single_precision_network_stay_single(device):
    torch.manual_seed(0)
    network, x = PeriodicMLP(2, outputs=2).to(device), uniform(2, device=device, dtype=torch.float32)
    double = PeriodicMLP(2, outputs=2).to(device).double()
    double.load_state_dict(network.state_dict())
    found, exact = jets.divergence(network, x), jets.divergence(double, x.double())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), exact, rtol=1e-3, atol=1e-4)
