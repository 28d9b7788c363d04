"""The proved lower bound with noise: second derivatives lie in their models, and the bound meets exact truth from below."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.certificate import Run, Trained, certify_fields
from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.certificate.proof.cover import cell_models
from ocp_torch.certificate.proof.enclosures import Enclosure, constant_noise, enclosure
from ocp_torch.certificate.proof.models import Box
from ocp_torch.certificate.proof.network_model import network_model
from ocp_torch.certificate.proof.rigorous import contradiction, obstacle, rigorous_lower_bound
from ocp_torch.certificate.proof.waves import matrix_model
from ocp_torch.fields import Fields, PeriodicMLP, SobolevField
from ocp_torch.fields.activations import ACTIVATIONS
from ocp_torch.maths.jets import jet
from ocp_torch.problems import Circle, Lipschitz, Manufactured, Torus
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.exact.trigonometric import WavyMatrix
from support import zoo
from support.cells import corners_and_inside, flat, grid, holds, network, random_box
from support.honesty import BARE

TURN = 2.0 * math.pi


def sobolev(dim: int, seed: int, modes: int = 3) -> SobolevField:
    field = SobolevField(dim, modes=modes, scaled=True, shift=0.3, scale=1.7).double().requires_grad_(False)
    field.coefficients.copy_(torch.randn(field.coefficients.shape, generator=torch.Generator().manual_seed(seed)))
    return field


def field_of(kind: str, dim: int, seed: int, gated: bool, depth: int):
    return sobolev(dim, seed) if kind == "sobolev" else network(dim, seed, activation=kind, gated=gated, depth=depth)


@settings(max_examples=20)
@given(
    dim=st.sampled_from([1, 2]),
    degree=st.integers(2, 6),
    level=st.integers(2, 9),
    kind=st.sampled_from(["sobolev", *sorted(ACTIVATIONS)]),
    gated=st.booleans(),
    depth=st.integers(1, 3),
    seed=st.integers(0, 10**6),
)
def test_the_jet_of_a_field_lies_in_its_models(dim, degree, level, kind, gated, depth, seed):
    V = field_of(kind, dim, seed, gated, depth)
    sigma = WavyMatrix(dim, dim, True, torch.Generator().manual_seed(seed))
    box = random_box(dim, level, degree, seed)
    t = corners_and_inside(box)
    found = network_model(V, box, matrix_model(sigma, box))
    assert holds(found.value, flat(V, box, t), t)
    assert holds(found.gradient, flat(lambda x: jet(V, x).gradient, box, t), t)
    assert holds(found.curvature, flat(lambda x: jet(V, x, sigma(x)).curvature, box, t), t)
    plain = network_model(V, box)
    assert torch.equal(plain.value.radius, found.value.radius)
    assert torch.equal(plain.gradient.radius, found.gradient.radius)


@pytest.mark.parametrize("kind", ["sobolev", "tanh"])
@pytest.mark.parametrize("degree", [3, 4])
def test_the_radius_of_the_curvature_shrinks_one_order_slower_than_that_of_the_gradient(kind, degree):
    V, problem, radii = field_of(kind, 2, 3, False, 2), Torus(2, noise=0.02), []
    centre = random_box(2, 9, degree, 0).centre
    for level in (9, 10):  # small enough, and well above the floor of rounding
        box = Box(centre, torch.full_like(centre, 0.5 / 2**level), degree)
        radii.append(float(network_model(V, box, constant_noise(problem, box)).curvature.radius.median()))
    assert radii[0] / radii[1] == pytest.approx(2.0 ** (degree - 1), rel=0.35)


@pytest.mark.parametrize("kind", ["sobolev", "tanh", "gelu"])
def test_rounding_of_the_curvature_is_enclosed_on_small_cells(kind):
    V, problem, radii = field_of(kind, 2, 5, True, 2), Torus(2, noise=0.02), []
    for level in (12, 18, 24):
        box = random_box(2, level, 4, level)
        sigma = problem.noise(box.centre)
        found = network_model(V, box, constant_noise(problem, box)).curvature
        truth = jet(V, box.centre, sigma).curvature
        error = (found.coefficients[0] - truth).abs()
        assert bool((error <= found.radius + 1e-12 * (1.0 + truth.abs())).all())
        radii.append(float(found.radius.max()))
    assert max(radii) < 1e-2


def exact_field(problem: Manufactured) -> SobolevField:
    """`V*` itself, a trigonometric polynomial."""
    field = SobolevField(problem.dim, modes=4).double().requires_grad_(False)
    waves, sizes, V0 = field.features.frequencies, field.features.amplitudes(), problem.V0
    for wave, b, phase in zip(V0.waves, V0.amplitudes, V0.phases, strict=True):
        for sign in (1.0, -1.0):
            for at in (waves == sign * wave).all(dim=1).nonzero().flatten().tolist():
                field.coefficients[1 + at] += b * phase.cos() / sizes[at]
                field.coefficients[1 + len(waves) + at] -= sign * b * phase.sin() / sizes[at]
    field.coefficients[0] = problem.c + V0.constant
    return field


ALL_VARIES = dict(state_dependent_noise=True, state_dependent_control=True, initial_contrast=0.7, exponent=1.5)
EXACT = {
    "1-d": partial(Manufactured, dim=1, noise=0.02),
    "1-d sigma(x)": partial(Manufactured, dim=1, noise=0.02, state_dependent_noise=True, initial_contrast=0.5),
    "2-d sigma(x)": partial(Manufactured, noise=[0.02, 0.01], state_dependent_noise=True),
    "2-d": partial(Manufactured, noise=0.02),
    "2-d one coordinate": partial(Manufactured, noise=[0.0, 0.05], initial_contrast=0.5),
    "2-d all varies": partial(Manufactured, noise=[0.02, 0.01], **ALL_VARIES),
}


FEW, MORE = [*EXACT][:3], [*EXACT][3:]


@pytest.mark.parametrize("name", [*FEW, *(pytest.param(n, marks=pytest.mark.nightly) for n in MORE)])
def test_the_bound_of_the_exact_value_function_is_the_optimum_up_to_the_tolerance(name):
    problem = EXACT[name]()
    V = exact_field(problem)
    torch.testing.assert_close(V(grid(problem.dim, 9)), problem.exact_value(grid(problem.dim, 9)), rtol=0, atol=1e-12)
    bound = rigorous_lower_bound(problem, V, sampled_slack=0.0)
    assert bound.complete
    assert bound.slack > 0.0
    assert problem.exact_optimum * (1.0 - 2e-3) <= bound.value <= problem.exact_optimum
    assert bound.integral[0] <= problem.exact_optimum <= bound.integral[1]


@pytest.mark.parametrize("name", ["1-d", "1-d sigma(x)"])
@pytest.mark.parametrize("kind", ["tanh", "gelu"])
def test_any_network_gives_a_bound_below_the_optimum_and_close_to_the_sampled_one(name, kind):
    problem = EXACT[name]()
    V = network(1, 3, activation=kind)
    x = grid(1, 20_001)
    largest, mean = float(slack_function(problem, V)(x).max()), float((V(x) * problem.initial_density(x)).mean())
    bound = rigorous_lower_bound(problem, V, sampled_slack=largest)
    assert bound.complete
    assert largest <= bound.slack <= largest + 1e-4
    assert bound.value <= mean - largest <= problem.exact_optimum
    assert bound.value == pytest.approx(mean - largest, abs=2e-4)


@pytest.mark.nightly
@pytest.mark.parametrize("name", [n for n in EXACT if n.startswith("2-d")])
def test_the_same_in_two_dimensions(name):
    problem, V = EXACT[name](), network(2, 5, modes=1, width=8, activation="silu")
    x = grid(2, 400)
    largest, mean = float(slack_function(problem, V)(x).max()), float((V(x) * problem.initial_density(x)).mean())
    bound = rigorous_lower_bound(problem, V, tolerance=2e-2, cells=2**14)
    assert largest <= bound.slack <= largest + 0.05 * float(V(x).abs().mean())
    assert bound.integral[0] <= mean <= bound.integral[1]
    assert bound.value <= problem.exact_optimum


def circle_field(problem: Circle, modes: int) -> SobolevField:
    """`V` with `Q = 0` in the least-squares sense, by Newton's method; the optimum is even, so cosines are enough."""
    x = grid(1, 4 * modes)
    k = TURN * torch.arange(modes + 1).double()
    cosines, slopes, bends = (x * k).cos(), -k * (x * k).sin(), -(k**2) * (x * k).cos()
    c, rho, nu = torch.zeros(modes + 1).double(), problem.discount, problem.diffusion[0]
    for _ in range(20):
        V1 = slopes @ c
        Q = (cosines - bends * nu / rho) @ c - problem.state_cost(x) + V1**2 / (2.0 * rho**2)
        c -= torch.linalg.lstsq(cosines - bends * nu / rho + V1[:, None] * slopes / rho**2, Q[:, None]).solution[:, 0]
    field = SobolevField(1, modes=modes).double().requires_grad_(False)
    field.coefficients[0], field.coefficients[1 : modes + 1] = c[0], c[1:] / field.features.amplitudes()
    return field


# By finite differences, to ten digits.
@pytest.mark.parametrize(("nu", "optimum"), [(1e-3, 0.0617187651), (1e-2, 0.0668854871), (5e-2, 0.0769037272)])
def test_the_bound_of_the_noisy_circle_is_below_the_optimum_and_near_it(nu, optimum):
    problem = Circle(noise=nu)
    value = rigorous_lower_bound(problem, circle_field(problem, 128)).value
    assert 0.98 * optimum <= value <= optimum


def test_a_wrong_model_of_the_noise_is_contradicted():
    problem = zoo.build("noisy 2-d sigma(x)")
    box = random_box(2, 6, 4, 0)
    found, t = enclosure(problem, box), corners_and_inside(box)[0]
    assert contradiction(problem, box, found, t) is None
    one_column = found.noise[:, :1]
    for wrong in (found.noise + 1e-3, found.noise * 0.99, one_column, None):
        assert contradiction(problem, box, replace(found, noise=wrong), t) == "noise"
    quiet = zoo.build("manufactured 2-d q=2")
    assert contradiction(quiet, box, replace(enclosure(quiet, box), noise=found.noise), t) == "noise"


class Driven(Circle):
    """Another noise under the enclosure of the circle."""

    def noise(self, x):
        return 0.1 + 0.05 * torch.cos(TURN * x).unsqueeze(-1)


class Forgetful(Circle):
    """An enclosure of one's own that leaves out the noise."""

    def enclosure(self, box):
        return replace(enclosure(Circle(), box), noise=None)


class Enclosed(Driven):
    """One that has it."""

    def enclosure(self, box) -> Enclosure:
        wave = box.cosine(torch.ones(1, 1).double(), torch.zeros(1).double())
        return replace(enclosure(Circle(), box), noise=(wave * 0.05 + 0.1)[..., None])


class Declared(zoo.NoisySwing):
    """Constants only."""

    def __init__(self, **constants):
        super().__init__()
        self.lipschitz = Lipschitz(state_cost=4.5, drift=2.0, control_matrix=2.8, initial_density=7.1, **constants)


def test_noise_without_a_model_is_refused_in_words():
    V, V2 = network(1, 0), network(2, 0)
    patched = Circle()
    patched.noise = lambda x: 0.1 * torch.ones_like(x).unsqueeze(-1)
    for problem, value, words in [
        (Driven(), V, "inherits"),
        (patched, V, "inherits"),
        (Forgetful(noise=0.01), V, "does not hold its own noise"),
        (zoo.NoisySwing(), V2, "lipschitz"),
        (Declared(), V2, "constants of noise (lipschitz)"),
        (Declared(noise=0.02), V2, "noise changes by 1.885 for each turn"),
    ]:
        assert words in obstacle(problem, value)
        assert rigorous_lower_bound(problem, value) is None
    assert obstacle(Enclosed(), V) is None
    assert obstacle(Declared(noise=1.9), V2) is None
    with pytest.raises(TypeError, match="leaves out its noise"):
        cell_models(Forgetful(noise=0.01), V, 1.0, random_box(1, 4, 4, 0))


@pytest.mark.parametrize("build", [Enclosed, partial(Declared, noise=1.9)])
def test_the_slack_under_noise_of_ones_own_lies_in_its_models(build):
    problem = build()
    V, box = network(problem.dim, 4), random_box(problem.dim, 7, 4, 2)
    t = corners_and_inside(box)
    Q, _ = cell_models(problem, V, 0.8, box)
    assert holds(Q, flat(slack_function(problem, lambda x: 0.8 * V(x)), box, t), t)


def test_the_certificate_of_a_noisy_problem_carries_the_proved_bound_when_asked():
    problem, V = Circle(noise=0.01), network(1, 0)
    bare = replace(BARE, points=256, replicates=2, trajectories=0, rigorous=True)
    trained = Trained(Fields({"value": V.requires_grad_(True)}), None, PeriodicMLP)
    certificate = certify_fields(problem, trained, resolve_constants(problem), bare, Run("test", "dual"))
    proved, sampled = certificate.lower["rigorous"], certificate.lower["shifted"]
    assert proved.value <= 0.0668854871
    assert proved.value == pytest.approx(sampled.value, abs=0.02)
