"""Every problem of the zoo: periodic, normalised, within its own bounds, and with an exact truth that solves the
Hamilton-Jacobi-Bellman and Liouville equations it is claimed to solve."""

import math

import pytest
import torch

from ocp_torch.certificate.lower.penalised import penalised
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.upper.penalised import density_bounds
from ocp_torch.errors import InputError
from ocp_torch.maths import jets
from ocp_torch.maths.sampling import evaluation_points
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems import Circle, Manufactured, Problem, Torus
from ocp_torch.problems.samples import Samples
from support import zoo
from support.exact import ROUNDING, exact_slack, lattice


@zoo.on(zoo.ALL)
def test_every_function_has_period_one_in_each_coordinate(problem):
    x = zoo.states(problem, 200, off_kinks=True)
    names = ["state_cost", "drift", "control_matrix", "initial_density", "drift_divergence", "control_divergence"]
    names += ["exact_value", "exact_control", "exact_occupation"] * (problem.exact_optimum is not None)
    for shift in (*torch.eye(problem.dim, dtype=torch.float64), torch.full((problem.dim,), -3.0, dtype=torch.float64)):
        for name in names:
            function = getattr(problem, name)
            torch.testing.assert_close(function(x + shift), function(x), **ROUNDING, msg=name)


@zoo.on(zoo.ALL)
def test_functions_give_the_documented_shapes(problem):
    d, m, x = problem.dim, problem.control_dim, zoo.states(problem, 7)
    samples = Samples.of(problem, x)
    shapes = {"f": (7,), "a": (7, d), "B": (7, d, m), "mu0": (7,), "weight": (7,), "div_a": (7,), "div_B": (7, m)}
    assert {name: tuple(getattr(samples, name).shape) for name in shapes} == shapes


@zoo.on(zoo.ALL)
def test_state_cost_is_never_negative_even_where_it_is_least(problem):
    x = zoo.states(problem, 2**15, seed=5)
    least = -supremum(lambda y: -problem.state_cost(y), x, ascents=64, steps=200).value
    assert least >= -1e-10


@zoo.on(zoo.ALL)
def test_known_bounds_hold_at_random_states(problem):
    x = zoo.states(problem, 2**15, seed=6)
    within = lambda values, bound: bound is None or float(values.max()) <= bound * (1.0 + 1e-9)
    assert within(problem.state_cost(x), problem.state_cost_bound)
    if problem.exact_optimum is not None:
        assert within(problem.exact_value(x), problem.value_bound)
        assert within(problem.exact_control(x).norm(dim=-1), problem.control_bound)
        assert within(problem.exact_occupation(x), problem.occupation_bound)


@zoo.on(zoo.EXACT)
def test_the_documented_supremum_of_the_occupation_is_attained(problem):
    x = evaluation_points(2**13, problem.dim, 0, seed=1)
    found = supremum(problem.exact_occupation, x, ascents=64, steps=200).value
    # The kinked problems peak in a cusp, to which the ascent climbs slowly.
    tolerance = 1e-6 if isinstance(problem, Manufactured) else 0.02
    assert found == pytest.approx(problem.occupation_bound, rel=tolerance)


@zoo.on(zoo.EXACT)
def test_the_optimal_control_is_as_large_as_its_bound_says(problem):
    x = evaluation_points(2**13, problem.dim, 0, seed=1)
    largest = supremum(lambda y: problem.exact_control(y).norm(dim=-1), x, ascents=64, steps=100).value
    assert largest == pytest.approx(problem.control_bound, rel=1e-3)


@zoo.on(zoo.ALL)
def test_densities_have_mean_one_and_are_not_negative(problem):
    sets = torch.stack([evaluation_points(2**13, problem.dim, r, seed=0) for r in range(8)])
    for density in (problem.initial_density, problem.exact_occupation):
        values = density(sets.flatten(0, 1))
        if values is not None:
            means = values.reshape(8, -1).mean(dim=1)
            # 5 standard errors of eight scramblings, or rounding where every one is exact.
            assert abs(float(means.mean()) - 1.0) <= 5.0 * float(means.std()) / math.sqrt(8.0) + 1e-9
            assert float(values.min()) >= 0.0


@zoo.on(zoo.EXACT)
def test_the_exact_value_solves_the_hamilton_jacobi_bellman_equation(problem):
    x = zoo.states(problem, 4000, seed=1, off_kinks=True)
    torch.testing.assert_close(exact_slack(problem, x), torch.zeros(len(x), dtype=x.dtype), **ROUNDING)


@zoo.on(zoo.EXACT)
def test_the_exact_occupation_and_control_solve_the_liouville_equation(problem):
    x = zoo.states(problem, 2000, seed=2, off_kinks=True)
    flux = lambda y: problem.exact_occupation(y).unsqueeze(-1) * problem.velocity(y, problem.exact_control(y))
    outflow = jets.divergence(flux, x) / problem.discount
    torch.testing.assert_close(problem.initial_density(x), problem.exact_occupation(x) + outflow, **ROUNDING)


@zoo.on(zoo.EXACT)
def test_the_exact_control_is_the_argmax_at_the_exact_value(problem):
    x = zoo.states(problem, 2000, seed=3, off_kinks=True)
    gradient = jets.jet(problem.exact_value, x).gradient
    pull = torch.einsum("ndm,nd->nm", problem.control_matrix(x), gradient)
    expected = problem.control_cost.argmax(-pull / problem.discount)
    torch.testing.assert_close(problem.exact_control(x), expected, **ROUNDING)


@zoo.on(zoo.EXACT)
def test_the_optimum_is_the_mean_of_the_exact_value(problem):
    if isinstance(problem, Manufactured):
        x = lattice(problem.dim)
        mean = float((problem.exact_value(x) * problem.initial_density(x)).mean())
        assert problem.exact_optimum == pytest.approx(mean, rel=1e-12)
    else:
        x = torch.cat([evaluation_points(2**15, problem.dim, r, seed=0) for r in range(8)])
        # 2^18 scrambled Sobol points integrate a piecewise quadratic to better than 1e-5.
        assert problem.exact_optimum == pytest.approx(float(problem.exact_value(x).mean()), rel=1e-5)


@zoo.on(zoo.SMOOTH)
def test_the_bounds_at_the_exact_truth_are_the_optimum(problem):
    """`F_M(V*) = OPT = J(w*, mu*)` by a quadrature that is exact; also the shifted bound, for `V*` is a subsolution."""
    grid = lattice(problem.dim)
    sets = [Samples.of(problem, grid), Samples.of(problem, grid + 0.37)]
    lower = SampledValue(problem, problem.exact_value, sets)
    w = lambda x: problem.exact_occupation(x).unsqueeze(-1) * problem.exact_control(x)
    J, G, *_ = density_bounds(problem, w, problem.exact_occupation, sets, problem.value_bound)
    for estimate in (penalised(lower, problem.occupation_bound), lower.best.estimate, J):
        assert estimate.value == pytest.approx(problem.exact_optimum, rel=1e-9)
    assert G is None


@zoo.on(zoo.KINKED)
def test_the_upper_bounds_at_the_exact_truth_are_the_optimum_without_drift(problem):
    """`mu*`, and `w*` with it, vanishes where `u*` jumps: the flux has no singular part that sampled states would miss."""
    sets = [Samples.of(problem, evaluation_points(2**13, problem.dim, r, seed=0)) for r in range(8)]
    w = lambda x: problem.exact_occupation(x).unsqueeze(-1) * problem.exact_control(x)
    for estimate in density_bounds(problem, w, problem.exact_occupation, sets, problem.value_bound)[:2]:
        assert abs(estimate.value - problem.exact_optimum) <= 5.0 * estimate.se + 1e-9


def test_the_circle_has_the_numbers_of_the_paper():
    circle = Circle(discount=2.0)
    assert circle.exact_optimum == pytest.approx(0.0610042339640731, abs=1e-15)
    x = torch.linspace(0.0, 1.0, 50, dtype=torch.float64)[:-1].unsqueeze(-1)
    torch.testing.assert_close(circle.state_cost(x), (x * (x - 1.0) + 0.25).squeeze(-1), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("rho", [0.5, 1.0, 2.0, 4.0])
def test_the_occupation_of_the_circle_is_the_formula_of_the_paper(rho):
    """Section 4.4: `b/(1-b) ((1/2)^{1-b} |x-1/2|^{b-1} - 1)` with `b = rho^2/(2 alpha)`, and `-log |2x-1|` at `rho = 1`."""
    x = torch.tensor([0.0, 0.01, 0.2, 0.4999, 0.5001, 0.7, 0.99], dtype=torch.float64)
    alpha = (math.sqrt(1.0 + 8.0 / rho**2) - 1.0) * rho**2 / 4.0
    b = rho**2 / (2.0 * alpha)
    offset = (x - 0.5).abs()
    expected = -(2.0 * offset).log() if rho == 1.0 else b / (1.0 - b) * (0.5 ** (1.0 - b) * offset ** (b - 1.0) - 1.0)
    torch.testing.assert_close(Circle(rho).exact_occupation(x.unsqueeze(-1)), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("rho", "bounded"), [(0.5, False), (1.0, False), (1.001, True), (4.0, True)])
def test_the_occupation_of_the_circle_is_bounded_exactly_above_discount_one(rho, bounded):
    assert (Circle(rho).occupation_bound < math.inf) == bounded


@pytest.mark.parametrize("dim", [1, 3])
@pytest.mark.parametrize("rho", [0.05, 2.0, 1e2, 1e4, 1e6])
def test_the_exact_optimum_of_a_torus_has_all_digits_at_every_discount(rho, dim):
    """`alpha + 2 alpha^2 / rho^2 = 1 / d` is the Hamilton-Jacobi-Bellman equation of `V* = alpha |y - 1/2|^2`."""
    alpha = 12.0 * Torus(dim, discount=rho).exact_optimum / dim
    assert alpha + 2.0 * (alpha / rho) ** 2 == pytest.approx(1.0 / dim, rel=1e-14)


@pytest.mark.nightly
@zoo.on(zoo.EXACT)
def test_the_parameters_make_the_same_problem_again(problem):
    again, x = type(problem)(**problem.parameters), zoo.states(problem, 50)
    assert again.parameters == problem.parameters
    for name in ("state_cost", "drift", "control_matrix", "initial_density", "exact_value"):
        assert torch.equal(getattr(again, name)(x), getattr(problem, name)(x))


@pytest.mark.parametrize(
    ("make", "arguments", "field"),
    [
        (Circle, dict(discount=0.0), "problem.discount"),
        (Circle, dict(discount=math.nan), "problem.discount"),
        (Circle, dict(discount="2"), "problem.discount"),
        (Torus, dict(dim=0), "problem.dim"),
        (Torus, dict(dim=2.0), "problem.dim"),
        (Torus, dict(shear="chian"), "problem.shear"),
        (Torus, dict(seed=-1), "problem.seed"),
        (Manufactured, dict(dim=True), "problem.dim"),
        (Manufactured, dict(control_dim=3), "problem.control_dim"),
        (Manufactured, dict(control_dim=0), "problem.control_dim"),
        (Manufactured, dict(exponent=1.0), "problem.exponent"),
        (Manufactured, dict(exponent=2.5), "problem.exponent"),
        (Manufactured, dict(drift=-0.1), "problem.drift"),
        (Manufactured, dict(control_size=0.0), "problem.control_size"),
        (Manufactured, dict(contrast=1.0), "problem.contrast"),
        (Manufactured, dict(initial_contrast=1.5), "problem.initial_contrast"),
        (Manufactured, dict(state_dependent_control=1), "problem.state_dependent_control"),
        (Manufactured, dict(interaction=0), "problem.interaction"),
        (Manufactured, dict(seed=0.5), "problem.seed"),
    ],
)
def test_a_wrong_argument_is_refused_by_name(make, arguments, field):
    with pytest.raises(InputError, match=field):
        make(**arguments)


def test_a_problem_without_a_state_cost_says_what_is_missing():
    with pytest.raises(InputError, match="state_cost"):
        Problem(dim=1).state_cost(torch.zeros(1, 1))


class Geared(Manufactured):
    def control_matrix(self, x):
        return 2.0 * super().control_matrix(x)


def test_what_is_put_in_the_place_of_a_function_is_what_everybody_sees():
    """The class gives cost and fields by one evaluation, which knows nothing of a subclass or of a function set later."""
    plain, changed = Manufactured(dim=2), Geared(dim=2)
    x, u = zoo.states(plain, 16), zoo.states(plain, 16, seed=1)
    f, (a, B, div_a, div_B) = plain.cost_and_fields(x)
    there = changed.cost_and_fields(x)
    for here, other in zip((f, a, 2.0 * B, div_a, div_B), (there[0], *there[1]), strict=True):
        torch.testing.assert_close(other, here, **ROUNDING)
    torch.testing.assert_close(changed.velocity(x, u), a + 2.0 * torch.einsum("ndm,nm->nd", B, u), **ROUNDING)
    plain.state_cost, plain.drift = lambda y: 7.0 + 0.0 * y[:, 0], lambda y: 0.0 * y
    assert bool((plain.cost_and_fields(x)[0] == 7.0).all())
    assert bool((plain.vector_fields(x)[0] == 0.0).all())
