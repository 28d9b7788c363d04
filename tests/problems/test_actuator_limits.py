"""A limit for each actuator on problems that fall apart into circles with one limit each, whose optima add up."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.certificate import CertificateSettings, StageSettings
from ocp_torch.certificate.lower.penalised import penalised
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.proof.rigorous import rigorous_lower_bound
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.certificate.upper.penalised import density_bounds
from ocp_torch.control.policies import CLOSED, ValuePolicy, admissible_density, occupation_density
from ocp_torch.control.saved import load_controller
from ocp_torch.maths import jets
from ocp_torch.problems import Torus
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.runs.external import certify
from ocp_torch.studies.reference.reference import solve_reference
from support import zoo
from support.exact import lattice
from support.formulas import ERRORS, random_fields
from support.small import session, small

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")


def circle_value(z: torch.Tensor, c: float, weight: float, rho: float) -> torch.Tensor:
    """`V*` at the distance ``z <= 1/2`` from the goal: `dz/dt = u`, `|u| <= c`, at the cost ``weight`` `z^2 + u^2 / 2`.

    `alpha z^2` up to where `V*' = rho c`. From there on the control stays at its limit, and `V + c V' / rho = weight z^2 +
    c^2 / 2` is linear: a parabola, and a decaying rest so that both meet.
    """
    alpha = (math.sqrt(1.0 + 8.0 * weight / rho**2) - 1.0) * rho**2 / 4.0
    knee, lag = c * rho / (2.0 * alpha), c / rho
    parabola = lambda z: weight * (z**2 - 2.0 * lag * z + 2.0 * lag**2) + c**2 / 2.0
    rest = (alpha * knee**2 - parabola(knee)) * ((knee - z).clamp_max(0.0) / lag).exp()
    return torch.where(z <= knee, alpha * z**2, parabola(z) + rest)


def torus_value(problem: Torus, x: torch.Tensor) -> torch.Tensor:
    """`V*` of a torus with a limit for each actuator: each moves a `y_i = (A x)_i` of its own."""
    z = ((x @ problem.A.to(x).T).remainder(1.0) - 0.5).abs()
    each = enumerate(problem.control_limit)
    return sum(circle_value(z[:, i], c, 1.0 / problem.dim, problem.discount) for i, c in each)


def torus_optimum(problem: Torus) -> float:
    """Its mean over each `y_i` by Simpson's rule, to 1e-10."""
    z = torch.linspace(0.0, 0.5, 2001, dtype=torch.float64)
    weights = torch.ones_like(z)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    each = (circle_value(z, c, 1.0 / problem.dim, problem.discount) for c in problem.control_limit)
    return sum(float((weights * v).sum()) / (3.0 * 2000) for v in each)


BOTH, ONE = [0.05, 0.15], [0.05, 1.0]  # of two limits, those that are reached


def test_the_formula_is_that_of_the_circle():
    """Where the limit is out of reach; and one coordinate alone, on a fine grid."""
    free = Torus(dim=2, control_limit=[9.0, 9.0])
    assert free.exact_optimum == pytest.approx(torus_optimum(free), rel=1e-8)
    tight = Torus(dim=1, control_limit=[0.1])
    reference = solve_reference(tight, side=512)
    assert tight.exact_optimum is None
    assert abs(reference.optimum - torus_optimum(tight)) <= max(reference.error, 1e-6)
    assert float((reference.value - torus_value(tight, reference.solution.grid.nodes())).abs().max()) < 1e-4


@pytest.mark.nightly
@pytest.mark.parametrize(("shear", "limit"), [("none", BOTH), pytest.param("chain", ONE, marks=pytest.mark.nightly)])
def test_the_optima_on_the_grid_add_up(shear, limit):
    problem = Torus(shear=shear, control_limit=limit)
    reference = solve_reference(problem, side=48)
    assert abs(reference.optimum - torus_optimum(problem)) <= reference.error <= 2e-2 * torus_optimum(problem)
    off = reference.solution.value - torus_value(problem, reference.solution.grid.nodes())
    assert float(off.abs().median()) < 1e-5
    assert float(off.abs().max()) < 1.0 / 48.0  # on a kink the grid is blurred over a cell
    # One limit on the length of the control is less than the box that it fits into, and more than one that fits into it.
    inside, around = (
        solve_reference(Torus(shear=shear, control_limit=c), side=48) for c in (min(limit), math.hypot(*limit))
    )
    assert around.optimum - around.error <= torus_optimum(problem) <= inside.optimum + inside.error


@pytest.mark.nightly
@settings(max_examples=6)
@given(
    limit=st.sampled_from([BOTH, ONE, [0.01, 0.02]]),
    shear=st.sampled_from(["none", "chain"]),
    seed=st.integers(0, 10**6),
    size=st.sampled_from([1e-2, 0.1, 1.0]),
    near=st.booleans(),
)
def test_no_networks_give_bounds_on_the_wrong_side(limit, shear, seed, size, near):
    """Without drift: `mu` in closed form, for whatever `w`; and a value far from the truth, or near to it."""
    problem, network = Torus(shear=shear, control_limit=limit), zoo.rough_network(2, seed, size=size)
    optimum, fields, constants = torus_optimum(problem), random_fields(problem, seed, size), resolve_constants(problem)
    sets = replicated_samples(problem, 128, 8, seed=seed, divergences=True)
    lower = SampledValue(
        problem, (lambda x: torus_value(problem, x) + network(x)) if near else network, sets, ascents=4
    )
    # At its limit an actuator contracts nothing: mu* is below what it can be without limits.
    for low in (lower.best.estimate, penalised(lower, Torus(shear=shear).occupation_bound)):
        assert low.value <= optimum + ERRORS * low.se + 1e-9
    form = (CLOSED, problem, fields, constants)
    J, G, *_ = density_bounds(problem, admissible_density(*form), occupation_density(*form), sets, constants.C_V)
    for high in (J, G):
        assert high.value >= optimum - ERRORS * high.se - 1e-9


@pytest.mark.parametrize("limit", [BOTH, ONE])
def test_the_bounds_at_the_value_of_the_formula_are_the_optimum(limit):
    """On a lattice off the kinks, whose midpoint rule leaves 1e-4."""
    problem, x = Torus(control_limit=limit), lattice(2) + 1.0 / 64.0
    lower = SampledValue(
        problem, lambda x: torus_value(problem, x), [Samples.of(problem, x), Samples.of(problem, x + 0.5)]
    )
    for estimate in (penalised(lower, 9.0), lower.best.estimate):
        assert estimate.value == pytest.approx(torus_optimum(problem), rel=1e-3)


def test_the_proved_bound_stands_and_its_slack_holds_all_that_is_met():
    network = zoo.rough_network(2, 3, size=0.02)
    free, tight = Torus(), Torus(control_limit=ONE)
    without, within = (rigorous_lower_bound(problem, network, cells=400) for problem in (free, tight))
    assert without.value - 1e-9 <= within.value <= torus_optimum(tight)
    x = zoo.states(tight, 4000)
    met = Generator.of(tight, Samples.of(tight, x)).hjb_slack(jets.jet(lambda y: within.theta * network(y), x))
    assert float(met.max()) <= within.slack


@pytest.mark.nightly
def test_a_given_controller_costs_what_it_costs_and_no_less_than_the_optimum():
    """The controller of the formula is optimal, the one that is clipped to a smaller box is not."""
    problem = Torus(shear="none", control_limit=BOTH)
    settings = CertificateSettings(points=256, replicates=4, trajectories=256, stage=StageSettings(steps=0))
    best = ValuePolicy(problem, lambda x: torus_value(problem, x))
    perf = lambda policy: certify(problem, policy, settings=settings, train_steps=0).perf["given"]
    optimal, clipped = perf(lambda x: best(x).detach()), perf(lambda x: best(x).detach().clamp(-0.04, 0.04))
    assert abs(optimal.value - torus_optimum(problem)) <= ERRORS * optimal.se + optimal.bias
    assert clipped.value - torus_optimum(problem) >= ERRORS * clipped.se
    assert clipped.value <= 1.1 * torus_optimum(problem)


@pytest.mark.nightly
def test_a_short_training_brackets_the_sum_of_the_optima(tmp_path):
    typed = ("problem=torus", "problem.shear=none", f"problem.control_limit={BOTH}", "method=pd")
    effort = ("trainer.steps=400", "trainer.batch=128", "model.width=48", "optimizer.lr=0.01", "trainer.figures=false")
    quick = ("certificate.points=1024", "certificate.stage.steps=200", "certificate.trajectories=64")
    trainer = small(*typed, *effort, *quick)
    certificate, optimum = session(trainer, tmp_path), torus_optimum(trainer.problem)
    lows, highs = (tuple(e for e in found.values() if e) for found in (certificate.lower, certificate.upper))
    assert all(low.interval(0.99999)[0] <= optimum for low in lows)
    perf = tuple(e for e in certificate.perf.values() if e)
    assert all(high.interval(0.99999)[1] >= optimum for high in (*highs, *perf))
    assert min(e.value for e in (*highs, *perf)) <= 1.1 * optimum
    u = load_controller(tmp_path / "controller.safetensors")
    assert u.problem.control_limit == BOTH
    assert bool((u(torch.rand(500, 2)).abs() <= torch.tensor(BOTH) * (1.0 + 1e-5)).all())
    assert certificate.contradiction is None
