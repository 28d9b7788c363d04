"""A limit `|u| <= c`: closed forms against brute force, gradients against differences, bounds against exact truth."""

import math
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.certificate import CertificateSettings, StageSettings
from ocp_torch.certificate.external.black_box import BlackBox
from ocp_torch.certificate.lower.penalised import penalised
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.proof.enclosures import conjugate_model
from ocp_torch.certificate.proof.models import Box
from ocp_torch.certificate.proof.rigorous import obstacle, rigorous_lower_bound
from ocp_torch.certificate.statistics.estimate import Estimate, replicated_samples
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.certificate.upper.penalised import density_bounds
from ocp_torch.control.policies import CLOSED, NETWORK, SADDLE, admissible_density, occupation_density, trained_policies
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError
from ocp_torch.maths import jets
from ocp_torch.objectives import Phase
from ocp_torch.objectives.primal import ClosedPrimal, NetworkPrimal
from ocp_torch.objectives.saddle import Saddle
from ocp_torch.problems import Circle, Manufactured, Torus
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.control_cost import PowerCost
from ocp_torch.problems.control_limit import BoxLimitedCost, LimitedCost
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.runs.external import certify
from ocp_torch.runs.finish import controller_of
from ocp_torch.studies.kernel.rules import DualRule
from ocp_torch.studies.reference.reference import solve_reference
from support import zoo
from support.brute_force import BOUND, central_differences, columns, lowest, two_dimensional, value_and_gradients
from support.exact import ROUNDING, exact_slack, lattice
from support.formulas import ERRORS, random_fields
from support.small import session, small

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")

exponents, limits = st.floats(1.05, 2.0), st.floats(0.05, 5.0)
# Nothing so small that the brute force would divide 0 by 0.
lengths = st.floats(0.0, 20.0).map(lambda v: v if v > 1e-50 else 0.0)
sizes = st.lists(lengths, min_size=1, max_size=20)
INFINITE = 1e30


def column(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def per_actuator(m: int, limits=limits):
    """Limits of ``m`` actuators."""
    return st.lists(limits, min_size=m, max_size=m).map(lambda c: BoxLimitedCost(2.0, c))


# Costs, with vectors for them to act on: those of a ball need only be tried in the plane.
ball = st.tuples(st.builds(LimitedCost, exponents, limits), sizes.map(lambda s: two_dimensional(column(s))))
entries = st.builds(math.copysign, lengths, st.sampled_from([-1.0, 1.0]))
rows = lambda m: st.lists(st.lists(entries, min_size=m, max_size=m), min_size=1, max_size=20).map(column)
box = st.integers(1, 3).flatmap(lambda m: st.tuples(per_actuator(m), rows(m)))


def least(cost, w) -> torch.Tensor:
    """The least `mu` that carries ``w``, written out."""
    if isinstance(cost, LimitedCost):
        return w.norm(dim=-1) / cost.limit
    return torch.stack([w[:, i].abs() / c for i, c in enumerate(cost.limit)]).amax(dim=0)


@given(sizes, exponents, limits)
def test_the_conjugate_is_the_supremum_over_the_ball(sizes, q, c):
    """The best control points along `p`, so a search over its length, up to the limit, suffices."""
    p = column(sizes)
    cost = LimitedCost(q, c)
    brute = torch.maximum(-lowest(lambda r: r**q / q - p.unsqueeze(-1) * r, 1e-80, c), column([0.0]))
    torch.testing.assert_close(cost.conjugate(two_dimensional(p)), brute, rtol=1e-8, atol=1e-12)
    best = cost.argmax(two_dimensional(p))
    assert float(best.norm(dim=-1).max()) <= c * (1.0 + 1e-12)
    attained = (best * two_dimensional(p)).sum(dim=-1) - cost.cost(best)
    torch.testing.assert_close(attained, brute, rtol=1e-8, atol=1e-12)


@given(st.integers(1, 3).flatmap(lambda m: st.tuples(per_actuator(m), rows(m))))
def test_the_conjugate_is_the_supremum_over_the_box(case):
    """Over a grid to the very corners, whose points miss a maximiser within by half a cell at most, and its value by half the
    square of that."""
    cost, p = case
    best = cost.argmax(p)
    assert (best.abs() <= column(cost.limit)).all()
    attained = (best * p).sum(dim=-1) - cost.cost(best)
    torch.testing.assert_close(attained, cost.conjugate(p), rtol=1e-12, atol=1e-12)
    u = torch.cartesian_prod(*[c * torch.linspace(-1.0, 1.0, 21, dtype=torch.float64) for c in cost.limit])
    u = u.reshape(-1, len(cost.limit))
    brute = (p @ u.T - u.square().sum(dim=-1) / 2.0).amax(dim=-1)
    missed = sum((c / 20.0) ** 2 / 2.0 for c in cost.limit)
    assert (brute <= attained + 1e-12 * (1.0 + attained)).all()
    assert (attained <= brute + missed + 1e-12 * (1.0 + attained)).all()


@settings(max_examples=60)
@given(ball | box, st.data())
def test_the_primal_minimum_is_the_least_value_over_occupations_that_can_carry_the_flux(case, data):
    cost, w = case
    numbers = lambda low, high: column(data.draw(st.lists(st.floats(low, high), min_size=len(w), max_size=len(w))))
    f, beta, size, from_ = numbers(0.0, 9.0), numbers(-4.0, 9.0), w.norm(dim=-1), least(cost, w)
    s, cost_, b, low = (t.unsqueeze(-1) for t in (size, f, beta, from_))
    running = lambda mu: cost_ * mu + mu * (s / mu) ** cost.q / cost.q + BOUND * torch.relu(b - mu)
    brute = lowest(lambda mu: torch.where(low <= mu * (1.0 + 1e-12), running(mu), math.inf), 1e-14, 1e300)
    on_the_limit = running(torch.where(s > 0.0, low, 1.0)).squeeze(-1)
    at_zero = torch.where(size == 0.0, BOUND * beta.clamp_min(0.0), on_the_limit)
    found = cost.primal_minimum(w, f, BOUND, beta)
    torch.testing.assert_close(found, torch.minimum(brute, at_zero), rtol=1e-7, atol=1e-10)
    mu = cost.primal_occupation(w, f, BOUND, beta)
    assert (mu >= from_ * (1.0 - 1e-12)).all()
    known = torch.isfinite(mu)
    value = f * mu + cost.perspective(w, mu) + BOUND * torch.relu(beta - mu)
    torch.testing.assert_close(value[known], found[known], rtol=1e-9, atol=1e-12)


@settings(max_examples=60)
@given(ball | box, st.data())
def test_the_saddle_minimum_is_the_least_value_up_to_the_bound(case, data):
    cost, w = case
    beta = column(data.draw(st.lists(st.floats(-5.0, 9.0), min_size=len(w), max_size=len(w))))
    size, from_ = w.norm(dim=-1), least(cost, w)
    s, b, low = (t.unsqueeze(-1) for t in (size, beta, from_))
    running = lambda mu: b * mu + mu * (s / mu) ** cost.q / cost.q
    brute = lowest(lambda mu: torch.where(low <= mu * (1.0 + 1e-12), running(mu), INFINITE), 1e-14, BOUND)
    on_the_limit = running(torch.where(s > 0.0, low, 1.0)).squeeze(-1)
    at_zero = torch.where(size == 0.0, 0.0, torch.where(from_ <= BOUND, on_the_limit, INFINITE))
    expected = torch.minimum(brute, at_zero)
    found = cost.saddle_minimum(w, beta, BOUND)
    clear = (from_ / BOUND - 1.0).abs() > 1e-6
    assert torch.equal(torch.isinf(found)[clear], (expected >= INFINITE)[clear])
    feasible = from_ <= BOUND * (1.0 - 1e-6)
    torch.testing.assert_close(found[feasible], expected[feasible], rtol=1e-7, atol=1e-10)
    mu = cost.saddle_occupation(w, beta, BOUND)
    value = beta * mu + cost.perspective(w, mu)
    torch.testing.assert_close(value[feasible], found[feasible], rtol=1e-9, atol=1e-12)
    # Whatever a network says, shrunk to what M allows, has a finite minimum.
    assert torch.isfinite(cost.saddle_minimum(cost.within(w, BOUND), beta, BOUND)).all()


SOME = [*(LimitedCost(q, 0.4) for q in (1.05, 1.5, 2.0)), BoxLimitedCost(2.0, [0.4, 0.3])]
each_cost = pytest.mark.parametrize("cost", SOME, ids=lambda cost: f"q={cost.q:g} {cost.limit}")


@each_cost
@pytest.mark.parametrize("name", ["conjugate", "perspective", "primal", "saddle", "within", "argmax"])
def test_gradients_are_those_of_finite_differences(cost, name):
    generator = torch.Generator().manual_seed(1)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    # All of them within c M, beyond which the minimum of Lemma 3 is infinite.
    w, positive, signed, f = 1.6 * draw(400, 2) - 0.8, 0.1 + draw(400), 3.0 * draw(400) - 1.0, 2.0 * BOUND * draw(400)
    inside = 0.9 * (positive / least(cost, w)).unsqueeze(-1) * w
    function, inputs = {
        "conjugate": (cost.conjugate, (w,)),
        "perspective": (cost.perspective, (inside, positive)),
        "primal": (lambda w, beta: cost.primal_minimum(w, f, BOUND, beta), (w, signed)),
        "saddle": (lambda w, beta: cost.saddle_minimum(w, beta, BOUND), (w, signed)),
        "within": (lambda w, mu: cost.within(w, mu) @ column([0.3, -0.7]), (w, positive)),
        "argmax": (lambda p: cost.argmax(p) @ column([0.3, -0.7]), (w,)),
    }[name]
    found = value_and_gradients(function, *inputs)
    assert all(torch.isfinite(t).all() for t in found)
    for exact, differenced in zip(found[1:], central_differences(function, *inputs), strict=True):
        torch.testing.assert_close(exact, differenced, rtol=1e-5, atol=1e-6)


@each_cost
def test_how_the_argmax_changes_is_what_autograd_finds(cost):
    draw = lambda *shape: torch.randn(*shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    p, moved = 0.5 * draw(300, 2), draw(300, 2, 4)
    along = lambda k: torch.func.jvp(cost.argmax, (p,), (moved[..., k],))[1]
    torch.testing.assert_close(cost.argmax_along(p, moved), torch.stack([along(k) for k in range(4)], dim=-1))


@each_cost
def test_the_root_of_that_change_taken_twice_is_the_change(cost):
    draw = lambda *shape: torch.randn(*shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    p, moved = 0.5 * draw(300, 2), draw(300, 2, 4)
    root = lambda columns: cost.argmax_root(p, columns)
    torch.testing.assert_close(root(root(moved)), cost.argmax_along(p, moved))
    square = root(torch.eye(2, dtype=torch.float64).expand(300, 2, 2))
    torch.testing.assert_close(square, square.mT)


@each_cost
def test_the_gradient_of_the_conjugate_is_the_argmax_also_far_beyond_the_limit_in_single_precision(cost):
    p = (column([0.0, 1e-20, 0.1, 1.0, 1e3, 1e6]).unsqueeze(-1) * column([0.6, -0.8])).float()
    _, slope = value_and_gradients(cost.conjugate, p)
    torch.testing.assert_close(slope, cost.argmax(p), rtol=1e-5, atol=1e-12)


@each_cost
def test_nothing_is_lost_or_not_a_number_at_tiny_arguments_in_single_precision(cost):
    size, beta = columns((0.0, 1e-30, 1e-20, 1e-6), (-1.0, -1e-25, 0.0, 1e-25, 1e-3, 2.0))
    w = (size.unsqueeze(-1) * column([0.6, -0.8])).float()
    one = torch.ones(len(w))
    functions = {
        "conjugate": lambda w, beta: cost.conjugate(w),
        "within": lambda w, beta: cost.within(w, beta.relu()).sum(dim=-1),
        "primal": lambda w, beta: cost.primal_minimum(w, beta.detach().relu(), BOUND, one - beta),
        "saddle": lambda w, beta: cost.saddle_minimum(w, beta, BOUND),
    }
    for name, function in functions.items():
        found, truth = (value_and_gradients(function, w.to(t), beta.float().to(t)) for t in (one.dtype, beta.dtype))
        for single, double in zip(found, truth, strict=True):
            assert torch.isfinite(single).all(), name
            torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-9, msg=name)


@given(limits, st.lists(st.tuples(entries, entries, lengths), min_size=1, max_size=20))
def test_for_one_actuator_a_list_of_one_limit_is_that_limit(c, cases):
    """To rounding, in all that a cost says."""
    p, beta, f = (column(v) for v in zip(*cases, strict=True))
    said = []
    for cost in (LimitedCost(2.0, c), BoxLimitedCost(2.0, [c])):
        w = p.unsqueeze(-1)
        u = cost.argmax(w)
        of_p = cost.gauge(w), cost.conjugate(w), u, cost.within(w, f), cost.cost(u), cost.argmax_along(w, w[..., None])
        minima = cost.primal_minimum(w, f, BOUND, beta), cost.saddle_minimum(cost.within(w, BOUND), beta, BOUND)
        minimisers = cost.primal_occupation(w, f, BOUND, beta), cost.saddle_occupation(w, beta, BOUND)
        said.append([*of_p, *minima, *minimisers, cost.perspective(cost.within(w, f), f)])
    for one, other in zip(*said, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-13, atol=1e-300)


@given(exponents, st.floats(0.05, 20.0), st.booleans())
def test_a_limit_nobody_reaches_changes_nothing(q, c, boxed):
    q = 2.0 if boxed else q
    free, limited = PowerCost(q), BoxLimitedCost(q, [c, 2.0 * c]) if boxed else LimitedCost(q, c)
    size, f, beta = columns((0.0, 0.01, 0.5), (0.2, 2.0, 7.0), (-1.0, 0.5, 4.0))
    w, p = two_dimensional(0.01 * c * size), two_dimensional(0.5 * c ** (q - 1.0) * size)
    assert torch.equal(free.conjugate(p), limited.conjugate(p))
    assert torch.equal(free.argmax(p), limited.argmax(p))
    mu = torch.ones_like(size)
    assert torch.equal(free.perspective(w, mu), limited.perspective(w, mu))
    assert torch.equal(w, limited.within(w, mu))


@pytest.mark.parametrize("cost", [LimitedCost(1.5, 2.0), BoxLimitedCost(2.0, [2.0, 0.1])])
def test_perspective_is_infinite_beyond_the_limit_and_closed_at_zero(cost):
    w, mu = column([[0.0, 0.0], [0.0, 1e-30], [2.0, 0.0], [2.001, 0.0]]), column([0.0, 0.0, 1.0, 1.0])
    at_limit = pytest.approx(2.0**cost.q / cost.q)
    assert cost.perspective(w, mu).tolist() == [0.0, math.inf, at_limit, math.inf]
    assert cost.cost(w).tolist()[2:] == [at_limit, math.inf]


LISTS = [[1.0], [1.0, 2.0, 3.0], [], [1.0, 0.0], [-1.0, 1.0], [1.0, math.nan], [1.0, "a"], [[1.0, 2.0]], [1.0, None]]


@pytest.mark.parametrize("limit", [0.0, -1.0, math.inf, math.nan, "1", True, {"u": 1.0}, *LISTS], ids=str)
def test_limits_that_are_none_are_refused(limit):
    with pytest.raises(InputError, match=r"^problem\.control_limit(\[.\])? is .* must be .*[^.]\.$"):
        Manufactured(control_limit=limit)


def test_a_limit_for_each_actuator_goes_with_squares_only():
    with pytest.raises(InputError, match=r"control_limit is \[1.0, 2.0\].*problem.exponent is 1.5.*exponent=2"):
        Manufactured(exponent=1.5, control_limit=[1.0, 2.0])


@pytest.mark.parametrize(
    ("cost", "dim"),
    [
        *((LimitedCost(q, 0.5), dim) for q in (1.2, 1.5, 2.0) for dim in (1, 2)),
        *((BoxLimitedCost(2.0, c), len(c)) for c in ([0.5], [0.5, 0.5], [0.5, 1.1])),
    ],
    ids=lambda value: str(value) if isinstance(value, int) else type(value).__name__,
)
def test_taylor_models_hold_the_conjugate_below_across_and_beyond_the_limit(cost, dim):
    """Coordinates of the cells themselves stand for `p`; cells of all sizes, within which random points are tried."""
    q, generator = cost.q, torch.Generator().manual_seed(0)
    for half in (0.2, 0.02, 1e-3):
        centre = 2.0 * torch.rand(300, dim, generator=generator, dtype=torch.float64)
        box = Box(centre, torch.full_like(centre, half), 4)
        model = conjugate_model(cost, box.coordinates())
        low, high = model.bounds()
        inner = 2.0 * torch.rand(20, 300, dim, generator=generator, dtype=torch.float64) - 1.0
        # The corner farthest from 0 is where R* exceeds its limited version most.
        for t in (*inner, torch.ones(300, dim, dtype=torch.float64)):
            truth = cost.conjugate(centre + half * t)
            assert ((low <= truth) & (truth <= high)).all()
            # And state by state: the polynomial there is within its radius of the truth.
            powers = torch.stack([(t ** t.new_tensor(alpha)).prod(dim=-1) for alpha in box.basis.exponents])
            off = ((powers * model.coefficients).sum(dim=0) - truth).abs()
            assert (off <= model.radius + 1e-12 * (1.0 + truth)).all()
        across = ((centre.norm(dim=-1) - 0.5 ** (q - 1.0)).abs() < half).nonzero()
        assert len(across) or half < 0.01
        if half == 1e-3:
            assert float((high - low).max()) < 0.02  # tight: the slope is at most c, the cell 1e-3 wide


@zoo.on(zoo.LIMITED)
def test_the_exact_truth_solves_its_equations_with_the_limit_reached(problem):
    x = zoo.states(problem, 4000, seed=1)
    torch.testing.assert_close(exact_slack(problem, x), torch.zeros(len(x), dtype=x.dtype), **ROUNDING)
    u = problem.exact_control(x)
    size = least(problem.control_cost, u)
    assert 0.001 < float((size >= 1.0 - 1e-9).double().mean()) < 0.98
    assert float(size.max()) <= 1.0 + 1e-12
    assert float(u.norm(dim=-1).max()) <= problem.control_bound * (1.0 + 1e-12)
    nu = torch.tensor(problem.diffusion or (0.0,) * problem.dim, dtype=x.dtype)
    spread = lambda y: nu * jets.jet(problem.exact_occupation, y).gradient
    carried = lambda y: problem.exact_occupation(y).unsqueeze(-1) * problem.velocity(y, problem.exact_control(y))
    flux = lambda y: carried(y) - spread(y)
    outflow = jets.divergence(flux, x) / problem.discount
    torch.testing.assert_close(problem.initial_density(x), problem.exact_occupation(x) + outflow, **ROUNDING)
    given, by_autograd = problem.drift_divergence(x), jets.divergence(problem.drift, x)
    torch.testing.assert_close(given, by_autograd, **ROUNDING)
    remade = type(problem)(**problem.parameters)
    assert torch.equal(remade.state_cost(x), problem.state_cost(x))


@pytest.mark.nightly
@zoo.on(zoo.LIMITED)
def test_the_bounds_at_the_exact_truth_are_the_optimum(problem):
    grid = lattice(problem.dim)
    sets = [Samples.of(problem, grid), Samples.of(problem, grid + 0.37)]
    lower = SampledValue(problem, problem.exact_value, sets)
    w = lambda x: problem.exact_occupation(x).unsqueeze(-1) * problem.exact_control(x)
    J, *_ = density_bounds(problem, w, problem.exact_occupation, sets, problem.value_bound)
    for estimate in (penalised(lower, problem.occupation_bound), lower.best.estimate):
        assert estimate.value == pytest.approx(problem.exact_optimum, rel=1e-9)
    # Where u* has kinks the integrand of J is only continuous: the lattice is not exact for it.
    assert J.value == pytest.approx(problem.exact_optimum, rel=5e-3)
    loop = ClosedLoop(problem, problem.exact_control)
    own = [Samples.of(loop, s.x) for s in sets]
    log_mu = lambda x: problem.exact_occupation(x).log()
    constants = closed_loop_bounds(loop, problem.exact_value, log_mu, own, ascents=4, controller="value")
    assert constants.lagrangian.value == pytest.approx(problem.exact_optimum, rel=1e-9)


@pytest.mark.nightly
@settings(max_examples=8)
@given(st.sampled_from(zoo.LIMITED), st.integers(0, 10**6), st.sampled_from([0.1, 1.0, 5.0]))
def test_random_networks_obey_weak_duality_and_the_limit(name, seed, size):
    """Networks that say anything: the density player's flux is cut to the limit, its divergence with it."""
    problem, fields = zoo.build(name), random_fields(zoo.build(name), seed, size)
    constants = resolve_constants(problem)
    sets = replicated_samples(problem, 256, 8, seed=seed, divergences=True)
    lower = SampledValue(problem, fields.value, sets, ascents=4)
    for low in (penalised(lower, constants.M), lower.best.estimate):
        assert low.value <= problem.exact_optimum + ERRORS * low.se + 1e-9
    form = (NETWORK, problem, fields, constants)
    J, *_ = density_bounds(problem, admissible_density(*form), occupation_density(*form), sets, constants.C_V)
    assert math.isfinite(J.value)
    assert J.value >= problem.exact_optimum - ERRORS * J.se - 1e-9
    phase = Phase(constants)
    losses = [NetworkPrimal(problem).losses(fields, s, phase)["density"].item() for s in sets]
    assert Estimate.of(losses).value == pytest.approx(J.value, rel=1e-9)
    x = zoo.states(problem, 200, seed=seed)
    for kind in (NETWORK, SADDLE):
        for policy in trained_policies(kind, problem, fields, constants).values():
            assert float(least(problem.control_cost, policy(x)).max()) <= 1.0 + 1e-9
    assert all(torch.isfinite(loss) for loss in Saddle(problem).losses(fields, sets[0], phase).values())


@settings(max_examples=10)
@given(st.integers(0, 10**6), st.sampled_from([0.1, 1.0, 5.0]), st.sampled_from([0.02, 0.1, 0.3, [0.02, 0.3]]))
def test_without_drift_the_closed_occupation_carries_any_flux(seed, size, limit):
    problem = Torus(control_limit=limit, seed=1)
    fields, constants = random_fields(problem, seed, size), resolve_constants(problem)
    sets = replicated_samples(problem, 256, 4, seed=seed, divergences=True)
    form = (CLOSED, problem, fields, constants)
    J, G, *_ = density_bounds(problem, admissible_density(*form), occupation_density(*form), sets, constants.C_V)
    assert J.value == pytest.approx(G.value, rel=1e-9)
    phase = Phase(constants)
    mean = Estimate.of([float(ClosedPrimal(problem).losses(fields, s, phase)["density"]) for s in sets]).value
    assert mean == pytest.approx(G.value, rel=1e-9)
    # A tighter limit costs more, never less.
    free = Torus(seed=1)
    unlimited = [float(ClosedPrimal(free).losses(fields, s, phase)["density"]) for s in sets]
    assert mean >= Estimate.of(unlimited).value - 1e-12


def test_exact_truth_is_claimed_only_where_the_limit_is_out_of_reach():
    near = Circle().control_bound
    assert Circle(control_limit=1.01 * near).exact_optimum == Circle().exact_optimum
    tight = Circle(control_limit=0.5 * near)
    x = column([[0.3]])
    told = (
        tight.exact_optimum,
        tight.value_bound,
        tight.occupation_bound,
        tight.exact_value(x),
        tight.exact_control(x),
    )
    assert told == (None,) * 5
    assert tight.exact_occupation(x) is None
    assert tight.control_bound == resolve_constants(tight).C_u == 0.5 * near
    assert resolve_constants(tight, control_bound=9.0).C_u == 0.5 * near


def test_rigorous_bounds_stand_with_a_limit_or_are_refused():
    network = zoo.rough_network(1, 3, size=0.05)
    free, tight = Circle(), Circle(control_limit=0.1)
    without, within = (rigorous_lower_bound(p, network, cells=2000) for p in (free, tight))
    assert within.value >= without.value - 1e-9  # R_c* <= R*
    x = torch.linspace(0.0, 1.0, 4001, dtype=torch.float64).unsqueeze(-1)
    met = Generator.of(tight, Samples.of(tight, x)).hjb_slack(jets.jet(lambda y: within.theta * network(y), x))
    assert float(met.max()) <= within.slack
    assert "enclosure" in obstacle(Manufactured(dim=1, control_limit=0.5), network)


def test_the_kernel_methods_refuse_a_limit():
    problem = Circle(control_limit=0.1)
    with pytest.raises(InputError, match=r"control_limit is 0\.1, but the kernel methods"):
        DualRule(problem, resolve_constants(problem))


@pytest.mark.parametrize(
    ("make", "side"),
    [
        (partial(Circle, control_limit=0.1), 128),
        pytest.param(partial(Manufactured, dim=1, control_limit=0.5, exponent=1.5), 128, marks=pytest.mark.nightly),
        pytest.param(partial(Manufactured, control_limit=[0.6, 0.3], seed=2), 48, marks=pytest.mark.nightly),
    ],
)
def test_the_grid_knows_the_limit(make, side):
    """Against exact truth, or against an upper and a lower bound that are easy to have."""
    problem = make()
    reference = solve_reference(problem, side=side)
    for u in (reference.control, reference.interpolate(zoo.states(problem, 200))[1]):
        assert float(least(problem.control_cost, u.reshape(-1, problem.control_dim)).max()) <= 1.0 + 1e-9
    if problem.exact_optimum is not None:
        assert abs(reference.optimum - problem.exact_optimum) <= max(reference.error, 1e-6)
    else:
        free = Circle().exact_optimum
        assert free + 1e-4 < reference.optimum < 1.0 / 12.0  # doing nothing costs the mean of f


@pytest.mark.parametrize(("limit", "shown"), [(0.5, r"0\.5;"), ([0.65, 0.5], r"\[0\.65, 0\.5\];")], ids=str)
def test_a_given_controller_that_breaks_the_limit_is_refused_with_its_state_and_size(limit, shown):
    problem = Manufactured(control_limit=limit)
    too_much = lambda x: 0.6 * torch.ones(len(x), 2)
    with pytest.raises(InputError, match=rf"u = \[0\.6, 0\.6\] of size 0\.848528 at x = \[.*control_limit is {shown}"):
        BlackBox(too_much, problem)(zoo.states(problem, 3))
    x, share = zoo.states(problem, 5), float(least(problem.control_cost, too_much(zoo.states(problem, 1)).double()))
    rounded = BlackBox(lambda x: too_much(x) / share * (1.0 + 1e-6), problem)
    assert float(least(problem.control_cost, rounded(x)).max()) <= 1.0 + 1e-12
    settings = CertificateSettings(points=64, replicates=2, trajectories=2, stage=StageSettings(steps=0))
    with pytest.raises(InputError, match="control_limit"):
        certify(problem, too_much, settings=settings, train_steps=0)


def test_one_trained_under_another_limit_is_held_against_this_one():
    trainer = small("problem=manufactured", "method=dual")
    certificate = SimpleNamespace(to_dict=dict)
    free = controller_of(trainer, certificate, "value", trainer.averaged_fields)
    for parameter in free.fields.parameters():
        parameter.data.mul_(3.0)
    settings = CertificateSettings(points=64, replicates=2, trajectories=2, stage=StageSettings(steps=0))
    for limit, shown in ((1e-4, r"0\.0001"), ([9.0, 1e-4], r"\[9\.0, 0\.0001\]")):
        with pytest.raises(InputError, match=f"control_limit is {shown}"):
            certify(Manufactured(control_limit=limit), free, settings=settings, train_steps=0)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("limit", "overrides"),
    [
        (0.02, ("method=primal",)),
        (0.02, ("method=pd", "method.augmentation=0")),
        ([0.02, 0.05], ("method=pd",)),
    ],
    ids=str,
)
def test_every_method_trains_with_a_limit_and_hands_out_a_controller_that_obeys(limit, overrides, tmp_path):
    quick = ("certificate.points=256", "certificate.trajectories=4", "certificate.ascents=2", "trainer.figures=false")
    limited = (f"problem.dim={2 if isinstance(limit, list) else 1}", f"problem.control_limit={limit}")
    trainer = small("problem=manufactured", *limited, *quick, *overrides)
    certificate = session(trainer, tmp_path)
    u = load_controller(tmp_path / "controller.safetensors")
    assert u.problem.control_limit == limit
    assert float(least(u.problem.control_cost, u(torch.rand(500, u.problem.dim)).double()).max()) <= 1.0 + 1e-5
    exact = certificate.exact
    for low in certificate.lower.values():
        assert low is None or low.interval(0.99999)[0] <= exact
    for high in (*certificate.upper.values(), *certificate.perf.values()):
        assert high is None or high.interval(0.99999)[1] >= exact


@pytest.mark.nightly
def test_a_short_run_certifies_near_the_exact_optimum(tmp_path):
    overrides = (
        "problem=manufactured",
        "problem.dim=1",
        "problem.control_limit=0.5",
        "method=dual",
        "trainer.steps=400",
    )
    overrides += ("trainer.batch=128", "model.width=48", "optimizer.lr=0.01", "trainer.evaluate_every=0")
    effort = ("certificate.points=2048", "certificate.stage.steps=200", "certificate.trajectories=8")
    trainer = small(*overrides, *effort)
    certificate = session(trainer, tmp_path)
    exact = trainer.problem.exact_optimum
    (_, low), (_, high) = certificate.best_lower, certificate.best_upper
    assert 0.97 * exact <= low <= exact * (1.0 + 1e-4)
    assert exact * (1.0 - 1e-4) <= high <= 1.03 * exact
    assert certificate.assumptions.hold, certificate.warnings
