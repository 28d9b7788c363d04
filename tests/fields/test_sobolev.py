"""Sobolev fields: their features are those of the kernel, their coefficients' norm is the space's, and they fit the rest."""

import itertools

import numpy as np
import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.fields import CONTROL_DENSITY, LOG_OCCUPATION, VALUE, Fields, PeriodicMLP, SobolevField
from ocp_torch.fields.sobolev import COMFORTABLE_FREQUENCIES, MOST_FREQUENCIES, SobolevFeatures
from ocp_torch.maths import jets
from ocp_torch.problems import Problem
from ocp_torch.steppers.stepper import project_on_ball
from ocp_torch.studies.kernel.expansions import BernoulliKernel
from support import zoo


def random_field(dim, outputs=None, seed=0, **options) -> SobolevField:
    field = SobolevField(dim, outputs, **options).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        field.coefficients.copy_(torch.randn(field.coefficients.shape, generator=generator))
    return field


@pytest.mark.parametrize(("dim", "regularity", "modes"), [(1, 2, 400), (1, 3, 100), (2, 3, 40)])
def test_inner_products_of_features_converge_to_the_bernoulli_kernel(dim, regularity, modes):
    """The tail of the spectrum beyond K is of order K^(1-2s), with a logarithm in two dimensions."""
    x, y = (zoo.states(Problem(dim), 20, seed) for seed in (0, 1))
    exact = BernoulliKernel(regularity).jets(x.numpy(), y.numpy())[..., 0, 0]
    errors = []
    for count in (modes // 2, modes):
        features = SobolevFeatures(dim, regularity, modes=count).double()
        errors.append(np.abs((features(x) * features(y)).sum(dim=1).numpy() - exact).max())
    tail = 20.0 * modes ** (1.0 - 2.0 * regularity)
    assert errors[1] < tail * np.log(modes) ** (dim - 1)
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize(("dim", "kernel", "modes"), [(1, "product", 7), (2, "product", 6), (3, "product", 4)])
def test_the_product_kernel_keeps_the_largest_weights_and_one_of_each_pair(dim, kernel, modes):
    chosen = SobolevFeatures(dim, kernel=kernel, modes=modes).frequencies.long().tolist()
    wanted = {
        w for w in itertools.product(range(-modes, modes + 1), repeat=dim) if np.prod(np.maximum(np.abs(w), 1)) <= modes
    }
    both = [tuple(sign * np.array(w)) for w in chosen for sign in (1, -1)]
    assert len(both) == len(set(both)) == len(wanted) - 1
    assert set(both) | {(0,) * dim} == wanted


@pytest.mark.parametrize(("dim", "modes"), [(1, 5), (2, 5), (3, 3), (16, 1)])
def test_the_isotropic_kernel_keeps_a_ball(dim, modes):
    chosen = SobolevFeatures(dim, 10.0, "isotropic", modes).frequencies.long()
    assert chosen.square().sum(dim=1).max() == modes**2
    if dim <= 3:
        inside = [
            w for w in itertools.product(range(-modes, modes + 1), repeat=dim) if 0 < np.square(w).sum() <= modes**2
        ]
        assert 2 * len(chosen) == len(inside)
    else:
        assert len(chosen) == dim


def test_amplitudes_are_the_square_roots_of_the_spectrum():
    x, y = zoo.states(Problem(2), 50, 0), zoo.states(Problem(2), 50, 1)
    features = SobolevFeatures(2, 3.0, "isotropic", 4).double()
    expected = torch.ones(50, dtype=torch.float64)
    for w in itertools.product(range(-4, 5), repeat=2):
        size = float(np.square(w).sum())
        if 0 < size <= 16:
            angle = 2 * torch.pi * (x - y) @ torch.tensor(w, dtype=torch.float64)
            expected = expected + size**-3.0 * angle.cos()
    torch.testing.assert_close((features(x) * features(y)).sum(dim=1), expected)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kernel", ["product", "isotropic"])
def test_closed_derivatives_agree_with_autograd(dim, kernel):
    field = random_field(dim, regularity=3.0, kernel=kernel, modes=3)
    x = zoo.states(Problem(dim), 30)
    found = field.jet(x)
    value, gradient = found.value, found.gradient
    plain, pullback = torch.func.vjp(field, x)
    torch.testing.assert_close(value, plain)
    torch.testing.assert_close(gradient, pullback(torch.ones_like(plain))[0])
    of_features = field.features.jets(x)
    torch.testing.assert_close(of_features[:, 0] @ field.coefficients, value)
    torch.testing.assert_close(of_features[:, 1:] @ field.coefficients, gradient)


def test_the_divergence_of_a_vector_field_matches_finite_differences():
    field, x, h = random_field(2, outputs=2, modes=3), zoo.states(Problem(2), 20), 1e-6
    B = torch.eye(2, dtype=torch.float64).expand(20, 2, 2)
    w, flux = jets.control_flux_divergence(field, x, B, torch.zeros(20, 2, dtype=torch.float64))
    steps = h * torch.eye(2, dtype=torch.float64)
    expected = sum((field(x + steps[k]) - field(x - steps[k]))[:, k] / (2 * h) for k in range(2))
    torch.testing.assert_close(w, field(x))
    torch.testing.assert_close(flux, expected, rtol=1e-6, atol=1e-6)


def test_fields_are_bitwise_periodic_in_single_precision():
    field = random_field(2, modes=5).float()
    x = torch.randint(2**10, (100, 2), generator=torch.Generator().manual_seed(0)) / 2**10
    reference = vars(field.jet(x)).values()
    for shift in (1.0, -3.0, 2.0**12):
        for found, expected in zip(vars(field.jet(x + shift)).values(), reference, strict=True):
            assert torch.equal(found, expected)


def test_amplitudes_do_not_keep_single_precisions_rounding():
    """The space is the same whether the network was made in double precision or converted to it."""
    converted = SobolevFeatures(1, modes=100).double().amplitudes()
    exact = 2.0**0.5 * torch.arange(1.0, 101.0, dtype=torch.float64) ** -2.0
    torch.testing.assert_close(converted, exact, rtol=1e-14, atol=0.0)


def test_a_gradient_step_on_the_coefficients_is_one_in_the_space():
    """The gradient of `V(x)` in the space is `K(x, .)`, and that of `V'(x)` its derivative in `x`."""
    field, kernel = SobolevField(1, modes=2000).double(), BernoulliKernel(2)
    x, y = torch.tensor([[0.3]], dtype=torch.float64), zoo.states(Problem(1), 50)
    found = field.jet(x)
    (found.value.sum() + 0.1 * found.gradient.sum()).backward()
    with torch.no_grad():
        moved = field.features(y) @ field.coefficients.grad
    jets = kernel.jets(x.numpy(), y.numpy())
    torch.testing.assert_close(moved.numpy(), jets[:, 0, 0] + 0.1 * jets[:, 1, 0], rtol=0.0, atol=1e-6)


def test_the_norm_is_that_of_the_space_and_its_ball_is_the_steppers():
    """`|V|^2 = (int V)^2 + int |V''|^2 / (2 pi)^4` for `s = 2` in one dimension."""
    field, n = random_field(1, modes=6), 64
    x = (torch.arange(n, dtype=torch.float64) / n).unsqueeze(-1)
    h = 1e-4
    second = (field(x + h) - 2.0 * field(x) + field(x - h)) / h**2
    norm = (field(x).mean() ** 2 + second.square().mean() / (2.0 * torch.pi) ** 4).sqrt()
    torch.testing.assert_close(field.norm, norm.detach(), rtol=1e-6, atol=0.0)
    project_on_ball([field.coefficients], 0.5)
    torch.testing.assert_close(field.norm, torch.tensor(0.5, dtype=torch.float64))


def test_without_units_fields_start_at_zero_and_with_them_at_the_shift():
    problem, x = zoo.build("swing"), zoo.states(zoo.build("swing"), 40)
    names = (VALUE, CONTROL_DENSITY, LOG_OCCUPATION)
    plain = Fields.build(problem, names, lambda **form: SobolevField(modes=2, **form), 0).double()
    assert all(not network(x).any() for network in plain.networks.values())
    units = Fields.build(problem, names, lambda **form: SobolevField(modes=2, scaled=True, **form), 0).double()
    perceptron = Fields.build(problem, names, PeriodicMLP, 0).double()
    for name in names:
        assert torch.equal(units.networks[name].scale, perceptron.networks[name].scale)
        assert (units.networks[name](x) == perceptron.networks[name].shift).all()
    assert plain.control_density(x).shape == (40, 1)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (dict(dim=1, regularity=1.5), "regularity"),
        (dict(dim=2, regularity=2.0, kernel="isotropic"), "regularity"),
        (dict(dim=1, modes=0), "modes"),
        (dict(dim=1, modes=MOST_FREQUENCIES + 1), "modes"),
        (dict(dim=12, modes=MOST_FREQUENCIES), "modes"),
        (dict(dim=1024, modes=2), "modes"),
        (dict(dim=16), "modes"),
        (dict(dim=1, kernel="gaussian"), "kernel"),
        (dict(dim=1, scaled="yes"), "scaled"),
    ],
)
def test_what_cannot_be_built_is_refused_in_one_sentence(options, word):
    with pytest.raises(InputError, match=f"model.{word}"):
        SobolevField(**options)


@pytest.mark.parametrize(("dim", "kernel"), [(1, "product"), (2, "product"), (4, "product"), (6, "isotropic")])
def test_modes_left_open_are_the_most_that_are_comfortable(dim, kernel):
    features = SobolevFeatures(dim, 8.0, kernel)
    largest = int(features.frequencies.abs().max())
    assert len(features.frequencies) <= COMFORTABLE_FREQUENCIES
    assert len(SobolevFeatures(dim, 8.0, kernel, largest + 1).frequencies) > COMFORTABLE_FREQUENCIES
