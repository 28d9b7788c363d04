"""`F_M(V) <= OPT <= J(w, mu)` and `G <= J` for any networks; losses and certificate must give the same numbers."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.certificate.lower.penalised import penalised
from ocp_torch.certificate.lower.sampled import SampledValue
from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.certificate.statistics.estimate import Estimate, replicated_samples
from ocp_torch.certificate.upper.lagrangian import closed_loop_bounds
from ocp_torch.certificate.upper.penalised import density_bounds
from ocp_torch.control.policies import CLOSED, NETWORK, occupation_density
from ocp_torch.fields import Fields
from ocp_torch.objectives import Dual, Phase, primal, saddle
from ocp_torch.objectives.primal import ClosedPrimal, NetworkPrimal
from ocp_torch.problems import Problem
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import Constants, resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo
from support.formulas import ERRORS, random_fields


@cache
def sets_of(name: str) -> list[Samples]:
    return replicated_samples(zoo.build(name), 512, 8, seed=0, divergences=True)


@cache
def bounds_of(name: str) -> Constants:
    return resolve_constants(zoo.build(name))


def paper_dual(problem: Problem) -> Dual:
    """`F_M` alone, without what training may add to it."""
    return Dual(problem, residual=0.0)


# Far from the truth and close to it: `size` is that of the network, `near` says whether it is added to the exact answer.
case = dict(
    name=st.sampled_from((*zoo.EXACT, *zoo.EXACT_NOISY)),
    seed=st.integers(0, 10**6),
    size=st.sampled_from([1e-3, 1e-2, 0.1, 1.0, 5.0]),
    near=st.booleans(),
)


def random_value(name: str, seed: int, size: float, near: bool):
    problem, network = zoo.build(name), zoo.rough_network(zoo.build(name).dim, seed, size=size)
    return (lambda x: problem.exact_value(x) + network(x)) if near else network


@settings(max_examples=30)
@given(**case)
def test_no_value_function_gives_a_penalised_bound_above_the_optimum(name, seed, size, near):
    problem, fields = zoo.build(name), SimpleNamespace(value=random_value(name, seed, size, near))
    dual, phase = paper_dual(problem), Phase(replace(bounds_of(name), M=problem.occupation_bound))
    F_M = Estimate.of([-float(dual.losses(fields, samples, phase)["value"]) for samples in sets_of(name)])
    assert F_M.value <= problem.exact_optimum + ERRORS * F_M.se + 1e-9


@pytest.mark.nightly
@settings(max_examples=6)
@given(**case)
def test_no_value_function_gives_a_shifted_bound_above_the_optimum(name, seed, size, near):
    problem, value = zoo.build(name), random_value(name, seed, size, near)
    shifted = SampledValue(problem, value, sets_of(name)).best.estimate
    assert shifted.value <= problem.exact_optimum + ERRORS * shifted.se + 1e-9


@settings(max_examples=40)
@given(**case)
def test_no_densities_give_an_upper_bound_below_the_optimum(name, seed, size, near):
    problem = zoo.build(name)
    fields = random_fields(problem, seed, size)
    w, mu = fields.control_density, lambda x: fields.log_occupation(x).exp()
    if near:
        exact_w = lambda x: problem.exact_occupation(x).unsqueeze(-1) * problem.exact_control(x)
        w = lambda x: exact_w(x) + fields.control_density(x)
        mu = lambda x: problem.exact_occupation(x) * fields.log_occupation(x).exp()
    J, G, *_ = density_bounds(problem, w, mu, sets_of(name), problem.value_bound)
    assert J.value >= problem.exact_optimum - ERRORS * J.se - 1e-9
    assert (G is None) == (not problem.still)
    if G is not None:
        assert problem.exact_optimum - ERRORS * G.se - 1e-9 <= G.value <= J.value * (1.0 + 1e-12)


@pytest.mark.nightly
@settings(max_examples=4)
@given(**{**case, "name": st.sampled_from((*zoo.SMOOTH, *zoo.EXACT_NOISY))})
def test_no_value_and_density_give_a_closed_loop_bound_below_the_optimum(name, seed, size, near):
    """For any regular controller, `V` and `mu`: the Lagrangian bound, and `J` with the `C_V` that these prove."""
    problem = zoo.build(name)
    fields, value = random_fields(problem, seed, size), random_value(name, seed, size, near)
    exact_log = lambda x: problem.exact_occupation(x).log()
    log_mu = (lambda x: exact_log(x) + fields.log_occupation(x)) if near else fields.log_occupation
    mistake = fields.control_density
    loop = ClosedLoop(problem, lambda x: problem.exact_control(x) + 0.1 * mistake(x))
    sets = [Samples.of(loop, samples.x) for samples in sets_of(name)]
    constants = closed_loop_bounds(loop, value, log_mu, sets, ascents=8, controller="value")
    for bound in (constants.lagrangian, constants.J):
        assert bound.value >= problem.exact_optimum - ERRORS * bound.se - 1e-9


@zoo.on(zoo.FEW_SMOOTH)
def test_the_lagrangian_bound_at_the_exact_truth_is_the_optimum(problem):
    loop = ClosedLoop(problem, problem.exact_control)
    sets = [Samples.of(loop, zoo.states(problem, 500, seed=s)) for s in (0, 1)]
    log_mu = lambda x: problem.exact_occupation(x).log()
    exact = closed_loop_bounds(loop, problem.exact_value, log_mu, sets, ascents=4, controller="value")
    expected = Estimate.of([float((problem.exact_value(s.x) * s.mu0).mean()) for s in sets])
    assert exact.lagrangian.value == pytest.approx(expected.value, rel=1e-9)
    outflows = [Generator.of(loop, s).occupation_outflow(log_mu)[1] for s in sets]
    assert all(float((s.mu0 - outflow).abs().mean()) < 1e-9 for s, outflow in zip(sets, outflows, strict=True))


@settings(max_examples=8)
@given(name=st.sampled_from(zoo.ALL), seed=st.integers(0, 10**6), size=st.sampled_from([0.1, 1.0, 5.0]))
def test_losses_are_the_numbers_of_the_certificate(name, seed, size):
    problem, sets = zoo.build(name), sets_of(name)[:2]
    fields, constants = random_fields(problem, seed, size), bounds_of(name)
    phase = Phase(constants)
    mean = lambda objective, player: (
        Estimate.of([float(objective.losses(fields, s, phase)[player]) for s in sets]).value
    )
    # One set at a time: with several the certificate takes off what plane waves explain of their noise.
    alone = [penalised(SampledValue(problem, fields.value, [s], ascents=1), constants.M).value for s in sets]
    F_M = Estimate.of(alone).value
    assert mean(paper_dual(problem), "value") == pytest.approx(-F_M, rel=1e-9, abs=1e-9)
    J, G, *_ = density_bounds(
        problem, fields.control_density, occupation_density(NETWORK, problem, fields, constants), sets, constants.C_V
    )
    assert mean(NetworkPrimal(problem), "density") == pytest.approx(J.value, rel=1e-9)
    if problem.still:
        assert mean(ClosedPrimal(problem), "density") == pytest.approx(G.value, rel=1e-9)
        closed = occupation_density(CLOSED, problem, fields, constants)
        attained, least, *_ = density_bounds(problem, fields.control_density, closed, sets, constants.C_V)
        assert attained.value == pytest.approx(least.value, rel=1e-9)


def test_the_primal_takes_the_closed_form_exactly_where_there_is_no_drift():
    for name, kind in (("torus 2-d chain", ClosedPrimal), ("manufactured 2-d q=2", NetworkPrimal)):
        assert type(primal(zoo.build(name))) is kind


@pytest.mark.nightly
@settings(max_examples=40)
@given(name=st.sampled_from(zoo.ALL), seed=st.integers(0, 10**6), size=st.sampled_from([0.1, 1.0, 5.0]))
def test_the_saddle_is_never_below_the_dual_and_meets_it_at_the_best_response(name, seed, size):
    """`inf_w Psi(V, w) = F_M(V)`, attained at `mu = M 1[Q > 0]`, `w = mu grad R*(-B^T grad V / rho)`."""
    problem, sets = zoo.build(name), sets_of(name)
    fields, constants = random_fields(problem, seed, size), bounds_of(name)

    def best_response(x):
        generator = Generator.of(problem, Samples.of(problem, x, divergences=False))
        V = generator.jet(fields.value)
        slack, u = generator.hjb_slack(V), problem.control_cost.argmax(generator.push(V))
        return torch.where(slack > 0.0, constants.M, 0.0).unsqueeze(-1) * u

    class BestResponse(torch.nn.Module):
        forward = staticmethod(best_response)

    paper_saddle, phase = saddle(problem, augmentation=0.0), Phase(constants)
    best = Fields({"value": fields.value, "control_density": BestResponse()})
    for samples in sets[:2]:
        dual = -float(paper_dual(problem).losses(fields, samples, phase)["value"])
        losses = paper_saddle.losses(fields, samples, phase)
        rounding = 1e-9 * (1.0 + abs(dual))
        assert float(losses["density"]) >= dual - rounding
        assert float(losses["value"]) == -float(losses["density"])
        assert float(paper_saddle.losses(best, samples, phase)["density"]) == pytest.approx(dual, abs=rounding)


@zoo.on(zoo.FEW)
def test_a_constant_is_worth_its_size_until_every_state_is_penalised(problem):
    """`F_M(V + c)` has slope 1 in `c` where all slacks are negative and slope `1 - M` where all are positive."""
    samples = Samples.of(problem, zoo.states(problem, 2048))
    network, M = random_fields(problem, seed=1).value, problem.occupation_bound
    slack, mass = slack_function(problem, network)(samples.x), float(samples.mu0.mean())
    dual, phase = paper_dual(problem), Phase(replace(resolve_constants(problem), M=M))
    F_M = lambda c: -float(dual.losses(SimpleNamespace(value=lambda x: network(x) + c), samples, phase)["value"])
    free, penalised = -float(slack.max()), -float(slack.min())
    assert F_M(free) - F_M(free - 1.0) == pytest.approx(mass, abs=1e-9)
    assert F_M(penalised + 1.0) - F_M(penalised) == pytest.approx(mass - M, abs=1e-9)
    # Concave in between.
    assert 2.0 * F_M(0.5 * (free + penalised)) >= F_M(free) + F_M(penalised)


@pytest.mark.nightly
@zoo.on(zoo.FEW)
def test_the_shifted_bound_undoes_a_constant_that_violates_the_constraint(problem):
    """The climbs are the same for every constant, up to rounding in which step is called better."""
    samples = Samples.of(problem, zoo.states(problem, 256))
    network = random_fields(problem, seed=1).value
    above = 1.0 - float(slack_function(problem, network)(samples.x).max())
    found = [
        SampledValue(problem, lambda x, c=c: network(x) + c, [samples] * 2, ascents=1) for c in (above, above + 3.0)
    ]
    change = found[1].best.estimate.value - found[0].best.estimate.value
    # Sampled, the mean of mu0 is not quite 1; what is left of that enters with the multiple of V that is shifted.
    low, high = sorted(3.0 * (float(samples.mu0.mean()) - 1.0) * side.own.theta for side in found)
    assert low - 1e-6 <= change <= high + 1e-6


@zoo.on(zoo.FEW)
def test_an_occupation_bound_below_one_gives_no_lower_bound(problem):
    """What `M >= sup mu*` is for: it is at least 1, and with less a large constant is rewarded."""
    sets = replicated_samples(problem, 512, 8, seed=0, divergences=False)
    found = penalised(SampledValue(problem, lambda x: problem.exact_value(x) + 100.0, sets, ascents=1), 0.9)
    assert found.value > problem.exact_optimum + 1.0


class Relabelled(Problem):
    """The same problem with its coordinates in another order."""

    def __init__(self, problem: Problem, order: list[int]) -> None:
        super().__init__(problem.dim, problem.control_dim, problem.discount, problem.exponent)
        self.inner, self.order, self.inverse = problem, order, torch.tensor(order).argsort()

    @property
    def driftless(self):
        return self.inner.driftless

    def state_cost(self, y):
        return self.inner.state_cost(y[:, self.inverse])

    def drift(self, y):
        return self.inner.drift(y[:, self.inverse])[:, self.order]

    def control_matrix(self, y):
        return self.inner.control_matrix(y[:, self.inverse])[:, self.order]

    def initial_density(self, y):
        return self.inner.initial_density(y[:, self.inverse])


@pytest.mark.parametrize("name", ["torus 3-d random", "manufactured 3-d m=2 B(x) q=1.5", "swing"])
def test_relabelling_the_coordinates_changes_nothing(name):
    problem, sets = zoo.build(name), sets_of(name)[:2]
    order = [2, 0, 1] if problem.dim == 3 else [1, 0]
    other = Relabelled(problem, order)
    fields, constants = random_fields(problem, seed=5), bounds_of(name)
    mu = occupation_density(NETWORK, problem, fields, constants)
    moved = [Samples.of(other, s.x[:, order]) for s in sets]
    read = lambda field: lambda y: field(y[:, other.inverse])
    here = penalised(SampledValue(problem, fields.value, sets, ascents=4), constants.M)
    there = penalised(SampledValue(other, read(fields.value), moved, ascents=4), constants.M)
    assert there.value == pytest.approx(here.value, rel=1e-11)
    J, *_ = density_bounds(problem, fields.control_density, mu, sets, constants.C_V)
    J_there, *_ = density_bounds(other, read(fields.control_density), read(mu), moved, constants.C_V)
    assert J_there.value == pytest.approx(J.value, rel=1e-11)
