"""The generator, its adjoint, the slacks and the residual against finite differences; all users of the slack together."""

import numpy as np
import pytest
import torch
from torch import Tensor

from ocp_torch.certificate.lower.slack import SlackParts, slack_function
from ocp_torch.certificate.proof.cover import cell_models
from ocp_torch.certificate.proof.models import Box
from ocp_torch.errors import InputError
from ocp_torch.maths.jets import Jet, jet
from ocp_torch.problems.generator import Generator, hjb_slack
from ocp_torch.problems.samples import Samples
from ocp_torch.studies.kernel.rules import Datum
from support import zoo

STEP, TOLERANCE = 1e-5, dict(rtol=1e-5, atol=1e-5)
MIXED = (
    "circle rho=2",
    "torus 2-d chain",
    "manufactured 3-d m=2 B(x) q=1.5",
    "limited 2-d q=1.5 B(x)",
    "box-limited 2-d",
    "swing",
)


def differences(field, x):
    """All first derivatives of ``field``, with the coordinate as last axis."""
    axes = STEP * torch.eye(x.shape[1], dtype=x.dtype)
    return torch.stack([(field(x + e) - field(x - e)) / (2.0 * STEP) for e in axes], dim=-1)


def setting(problem, count=64):
    """States, Samples, a generator, a `V` and a controller, all rough."""
    x = zoo.states(problem, count, seed=1, off_kinks=True)
    V = zoo.rough_network(problem.dim, seed=2, size=0.3)
    u = 0.2 * zoo.rough_network(problem.dim, seed=3, outputs=problem.control_dim)(x).tanh()
    samples = Samples.of(problem, x)
    return x, samples, Generator.of(problem, samples), V, u


@zoo.on(MIXED)
def test_the_generator_is_the_rate_of_change_along_the_system(problem):
    x, _, L, V, u = setting(problem)
    velocity = problem.velocity(x, u)
    rate = (V(x + STEP * velocity) - V(x - STEP * velocity)) / (2.0 * STEP)
    torch.testing.assert_close(L(jet(V, x), u), rate, **TOLERANCE)
    torch.testing.assert_close(L.uncontrolled(jet(V, x)), L(jet(V, x), 0.0 * u))


@zoo.on(MIXED)
def test_the_slacks_are_those_of_finite_differences(problem):
    x, samples, L, V, u = setting(problem)
    gradient, rho, cost = differences(V, x), problem.discount, problem.control_cost
    pushed = -torch.einsum("ndm,nd->nm", samples.B, gradient) / rho
    Q = V(x) - samples.f - (gradient * samples.a).sum(-1) / rho + cost.conjugate(pushed)
    torch.testing.assert_close(L.hjb_slack(jet(V, x)), Q, **TOLERANCE)
    Q_u = V(x) - samples.f - cost.cost(u) - (gradient * problem.velocity(x, u)).sum(-1) / rho
    torch.testing.assert_close(L.bellman_slack(jet(V, x), u), Q_u, **TOLERANCE)


@zoo.on(MIXED)
def test_the_slack_is_the_largest_over_controls(problem):
    x, _, L, V, u = setting(problem)
    jet_of_V = jet(V, x)
    best, Q = problem.control_cost.argmax(L.push(jet_of_V)), L.hjb_slack(jet_of_V)
    torch.testing.assert_close(L.bellman_slack(jet_of_V, best), Q)
    assert bool((L.bellman_slack(jet_of_V, u) <= Q + 1e-12).all())


@zoo.on(MIXED)
def test_the_residual_is_that_of_finite_differences(problem):
    """`mu0 - mu - div(a mu + B w) / rho`, with the flux differenced as one vector field."""
    x, samples, L, log_mu, _ = setting(problem)
    w = zoo.rough_network(problem.dim, seed=4, outputs=problem.control_dim)
    flux = lambda y: problem.velocity(y, w(y) / log_mu(y).exp().unsqueeze(-1)) * log_mu(y).exp().unsqueeze(-1)
    outward = differences(flux, x).diagonal(dim1=1, dim2=2).sum(-1)
    expected = samples.mu0 - log_mu(x).exp() - outward / problem.discount
    found, inflow = L.control_inflow(w)
    mu, outflow = L.occupation_outflow(log_mu)
    torch.testing.assert_close(found, w(x))
    torch.testing.assert_close(mu, log_mu(x).exp())
    torch.testing.assert_close(inflow - outflow, expected, **TOLERANCE)
    same, drifted, _ = L.drift_flux(lambda y: log_mu(y).exp())
    torch.testing.assert_close(same, mu)
    torch.testing.assert_close(mu + drifted / problem.discount, outflow)


@zoo.on(("circle rho=2", "manufactured 2-d B(x)", "swing"))
def test_generator_and_residual_are_adjoint(problem):
    """`E[-V mu + grad V . (a mu + B w) / rho] = E[V (r - mu0)]`: the mean over a grid is spectrally accurate."""
    side = torch.arange(128, dtype=torch.float64) / 128
    x = torch.cartesian_prod(*[side] * problem.dim).reshape(-1, problem.dim)
    samples = Samples.of(problem, x)
    L = Generator.of(problem, samples)
    V, log_mu = (zoo.rough_network(problem.dim, seed, size=0.3) for seed in (5, 6))
    w = zoo.rough_network(problem.dim, seed=7, outputs=problem.control_dim)
    (_, inflow), (mu, outflow) = L.control_inflow(w), L.occupation_outflow(log_mu)
    charged = L.multiplier_term(jet(V, x), mu, w(x)).mean()
    torch.testing.assert_close(charged, (V(x) * (inflow - outflow - samples.mu0)).mean(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
@zoo.on(("circle rho=2", "manufactured 1-d q=1.5", "manufactured 2-d B(x)", "manufactured 2-d mu0"))
@torch.no_grad()
def test_all_users_of_the_slack_agree(problem, seed):
    """Training, the shifted bound, its recombination and its ascents, the proof's cells and the kernel methods."""
    V, rho = zoo.rough_network(problem.dim, seed, size=0.5), problem.discount
    x = (zoo.states(problem, 100, seed) * 2**20).floor() / 2**20
    samples = Samples.of(problem, x)
    L, own = Generator.of(problem, samples), jet(V, x)
    Q, shift = L.hjb_slack(own), SlackParts.of(L, own)
    torch.testing.assert_close(shift.slack(1.0), Q)
    torch.testing.assert_close(slack_function(problem, V)(x), Q)
    torch.testing.assert_close(L.hjb_slack(own.map(lambda part: 0.7 * part)), shift.slack(0.7))
    cells, _ = cell_models(problem, V, 1.0, Box(x, torch.full_like(x, 2.0**-30), 3))
    torch.testing.assert_close(cells.coefficients[0], Q, rtol=0.0, atol=1e-7)
    datum = Datum(*(c.numpy() for c in (x, samples.f, samples.a, samples.B, samples.mu0, samples.div_B)), None)
    arrays, flat = Generator(datum, rho), own.map(Tensor.numpy)
    conjugate = problem.control_cost.conjugate(torch.from_numpy(arrays.push(flat))).numpy()
    np.testing.assert_allclose(
        hjb_slack(flat.value, datum.f, arrays.transport(flat), conjugate), Q, rtol=1e-9, atol=1e-12
    )
    np.testing.assert_allclose(arrays.reduced_cost(flat), -(Q - conjugate), rtol=1e-9, atol=1e-12)


def test_parts_of_a_jet_go_together():
    x, V = zoo.states(zoo.Problem(2), 10), zoo.rough_network(2, seed=0)
    whole, rows = jet(V, x), torch.tensor([3, 1])
    chosen, again = whole.map(lambda part: part[rows]), jet(V, x[rows])
    joined = Jet.concatenate([jet(V, x[:4]), jet(V, x[4:])])
    for name in ("value", "gradient"):
        torch.testing.assert_close(getattr(chosen, name), getattr(again, name))
        torch.testing.assert_close(getattr(joined, name), getattr(whole, name))


def test_without_divergences_there_is_no_residual():
    problem = zoo.build("swing")
    L = Generator.of(problem, Samples.of(problem, zoo.states(problem, 5), divergences=False))
    for residual in (L.control_inflow, L.occupation_outflow, L.drift_flux):
        with pytest.raises(InputError, match="divergences"):
            residual(zoo.rough_network(2, seed=0))
