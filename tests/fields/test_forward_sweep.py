"""Derivatives by one sweep forward against nested reverse passes, in float64 to 12 digits and more."""

import pytest
import torch

from ocp_torch.compute import threads as cores
from ocp_torch.fields import PeriodicMLP, SobolevField, mlp
from ocp_torch.fields.activations import ACTIVATIONS
from ocp_torch.fields.forward_sweep import Along
from ocp_torch.maths.batch_jet import PIECE_STATES, batch_jet
from ocp_torch.maths.jets import chunked_jet, curvature, jet, reverse_jet

# Columns of noise: none but one, fewer than coordinates, as many, more.
SHAPES = ((1, 1), (2, 1), (3, 2), (2, 2), (3, 3), (2, 4))
EXACT = dict(rtol=1e-12, atol=1e-12)


def made(dim, seed, **options):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = PeriodicMLP(dim, modes=2, width=12, depth=2, waves=4, shift=0.3, scale=2.0, **options).double()
        network.embedding.mix(torch.randint(-2, 3, (4, dim)))
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.4)
    return network


def drawn(dim, columns, seed=0, count=9):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)
    return draw(count, dim), draw(count, dim, columns)


def assert_same(found, expected):
    for name in ("value", "gradient", "curvature"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), **EXACT)


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize(("dim", "columns"), SHAPES)
def test_a_sweep_gives_what_nested_reverse_passes_give(dim, columns, activation, gated):
    """And so do its derivatives in the parameters, and in the states for noise that is data."""
    network, (x, sigma) = made(dim, dim, activation=activation, gated=gated), drawn(dim, columns)
    x.requires_grad_(True)
    swept, nested = jet(network, x, sigma), reverse_jet(network, x, sigma)
    assert_same(swept, nested)
    loss = lambda j: (j.value.sin() + j.gradient.square().sum(dim=-1) + j.curvature.square()).sum()
    inputs = [x, *network.parameters()]
    for found, expected in zip(*(torch.autograd.grad(loss(j), inputs) for j in (swept, nested)), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    with torch.no_grad():
        assert_same(jet(network, x, sigma), swept)


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize(("dim", "columns"), SHAPES)
def test_curvature_alone_is_the_same_also_from_many_pieces(dim, columns, gated, monkeypatch):
    network, (x, sigma) = made(dim, dim, gated=gated).requires_grad_(False), drawn(dim, columns, count=70)
    expected = reverse_jet(network, x, sigma).curvature
    torch.testing.assert_close(curvature(network, x, sigma), expected, **EXACT)
    monkeypatch.setattr(mlp, "SWEEP_SIZE", 1)
    torch.testing.assert_close(curvature(network, x, sigma), expected, **EXACT)
    torch.testing.assert_close(curvature(lambda at: network(at), x, sigma), expected, **EXACT)


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("dim", [1, 3])
def test_noise_along_the_coordinates_takes_the_short_way_to_the_same(dim, activation, gated):
    """Its reverse, which is written out, as well: in the parameters and in the states, on which the noise may depend."""
    network, (x, sigma) = made(dim, 7, activation=activation, gated=gated), drawn(dim, dim)
    x.requires_grad_(True)
    diagonal = torch.diag_embed(sigma.diagonal(dim1=1, dim2=2) * (1.5 + x.sin()))
    swept, nested = jet(network, x, diagonal), reverse_jet(network, x, diagonal)
    assert_same(swept, nested)
    loss = lambda j: (j.value.sin() + j.gradient.square().sum(dim=-1) + j.curvature.square()).sum()
    inputs = [x, *network.parameters()]
    gradients = [torch.autograd.grad(loss(j), inputs, retain_graph=True) for j in (swept, nested)]
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("dim", [2, 3])
def test_noise_that_is_the_same_everywhere_takes_the_short_way_to_the_same(dim, activation, gated):
    network, (x, sigma) = made(dim, 5, activation=activation, gated=gated), drawn(dim, dim)
    factor = sigma[:1].tril() + 2.0 * torch.eye(dim, dtype=torch.float64)
    x.requires_grad_(True)
    inputs = [x, *network.parameters()]
    loss = lambda j: (j.value.sin() + j.gradient.square().sum(dim=-1) + j.curvature.square()).sum()
    # One that differs at a single state, and one that is all but singular, go the long way.
    odd = factor.repeat(len(x), 1, 1)
    odd[3, 1, 0] += 0.5
    flat = factor * torch.tensor([1.0] + (dim - 1) * [1e-3], dtype=torch.float64)
    for noise, short in ((factor.expand(len(x), -1, -1), True), (odd, False), (flat.expand(len(x), -1, -1), False)):
        assert (Along.of(noise).frame is not None) == short
        swept, nested = jet(network, x, noise), reverse_jet(network, x, noise)
        assert_same(swept, nested)
        gradients = [torch.autograd.grad(loss(j), inputs, retain_graph=True) for j in (swept, nested)]
        for found, expected in zip(*gradients, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_noise_that_follows_the_state_has_its_own_derivative():
    network, (x, sigma) = made(2, 5), drawn(2, 2, count=1)
    x.requires_grad_(True)
    found, expected = (
        torch.autograd.grad(of(network, x, (sigma.tril() + 2.0 * torch.eye(2)) * (1.5 + x.sin())).curvature.sum(), x)[0]
        for of in (jet, reverse_jet)
    )
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("dim", "columns"), SHAPES)
def test_a_field_in_the_sobolev_space_has_its_curvature_in_closed_form(dim, columns):
    field, (x, sigma) = SobolevField(dim, regularity=3.0, modes=2, scaled=True, scale=1.5).double(), drawn(dim, columns)
    torch.nn.init.normal_(field.coefficients)
    assert_same(jet(field, x, sigma), reverse_jet(field, x, sigma))


@pytest.mark.parametrize(("dim", "columns"), SHAPES)
def test_curvature_is_that_of_second_differences(dim, columns):
    network, (x, sigma) = made(dim, 3), drawn(dim, columns)
    step = 1e-4
    moved = [network(x + step * s) + network(x - step * s) - 2.0 * network(x) for s in sigma.unbind(-1)]
    torch.testing.assert_close(jet(network, x, sigma).curvature, 0.5 * sum(moved) / step**2, rtol=1e-3, atol=1e-3)


def test_noise_that_varies_with_the_state_is_not_differentiated_in_the_curvature():
    """`D : hess V`, not `div(D grad V)`, also where `sigma` is a part of the graph of the states."""
    network, (x, _) = made(2, 5), drawn(2, 2)
    x.requires_grad_(True)
    sigma = torch.stack([x.sin(), 2.0 + x.cos()], dim=-1)
    for of in (jet, reverse_jet):
        assert_same(of(network, x, sigma), reverse_jet(network, x, sigma.detach()))
    live = lambda of: torch.autograd.grad(of(network, x, sigma).curvature.sum(), x, retain_graph=True)[0]
    torch.testing.assert_close(live(jet), live(reverse_jet), rtol=1e-10, atol=1e-10)


def test_a_constant_and_a_linear_field_have_no_curvature():
    x, sigma = drawn(2, 2)
    for field in (lambda y: torch.full_like(y[:, 0], 3.0), lambda y: y.sum(dim=-1)):
        assert torch.equal(jet(field, x, sigma).curvature, torch.zeros_like(x[:, 0]))


def test_transforms_of_functions_have_curvatures_too():
    network, (x, sigma) = made(2, 5), drawn(2, 2)
    x.requires_grad_(True)
    curvature = jet(network, x, sigma).curvature
    expected = torch.autograd.grad(curvature.sum(), x)[0]
    for field in (network, lambda y: network(y)):
        found, pull = torch.func.vjp(lambda at, field=field: jet(field, at, sigma).curvature, x.detach())
        torch.testing.assert_close(found, curvature, **EXACT)
        torch.testing.assert_close(pull(torch.ones_like(found))[0], expected, rtol=1e-10, atol=1e-10)
        found, change = torch.func.jvp(
            lambda at, field=field: jet(field, at, sigma).curvature, (x.detach(),), (x.detach(),)
        )
        torch.testing.assert_close(found, curvature, **EXACT)
        torch.testing.assert_close(change, (expected * x).sum(dim=-1), rtol=1e-10, atol=1e-10)


def test_a_jet_of_many_states_is_that_of_its_parts_and_scales_as_a_whole():
    network, (x, sigma) = made(2, 5), drawn(2, 3, count=23)
    whole = jet(network, x, sigma)
    assert_same(chunked_jet(network, x, sigma, chunk=10), whole)
    tripled = whole.map(lambda part: 3.0 * part)
    torch.testing.assert_close(tripled.gradient, 3.0 * whole.gradient, **EXACT)
    torch.testing.assert_close(tripled.curvature, 3.0 * whole.curvature, **EXACT)


@pytest.mark.parametrize("along", ["the coordinates", "columns"])
def test_a_large_batch_is_differentiated_in_pieces_to_the_same_on_any_number_of_cores(monkeypatch, along):
    network, (x, sigma) = made(3, 6), drawn(3, 3, count=2 * PIECE_STATES + 76)
    if along == "the coordinates":
        sigma = torch.diag_embed(sigma.diagonal(dim1=1, dim2=2))
    sizes = []
    network.embedding.register_forward_hook(lambda module, given, made: sizes.append(len(made)))
    loss = lambda j: (j.value.sin() + j.gradient.square().sum(dim=-1) + j.curvature.square()).mean()
    weights, found = list(network.parameters()), []
    for count in (1, 2):
        monkeypatch.setattr(cores, "cores", lambda count=count: count)
        found.append(torch.autograd.grad(loss(batch_jet(network, x, sigma)), weights))
        assert sorted(sizes) == [76, PIECE_STATES, PIECE_STATES]
        sizes.clear()
    whole = torch.autograd.grad(loss(jet(network, x, sigma)), weights)
    for one, two, other in zip(*found, whole, strict=True):
        assert torch.equal(one, two)
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)
    assert sizes == [len(x)]
