"""The control cost and its pointwise minimisers (Lemmas 2 and 3) against brute force, finite differences and float32."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ocp_torch.errors import InputError
from ocp_torch.problems.control_cost import PowerCost
from support.brute_force import BOUND, central_differences, columns, lowest, two_dimensional, value_and_gradients

EXPONENTS = (1.05, 1.2, 1.5, 1.8, 2.0)
each_exponent = pytest.mark.parametrize("q", EXPONENTS)


def primal_objective(size, f, residual, q):
    """`f mu + mu |w/mu|^q / q + C_V [beta - mu]_+`, one row per case."""
    size, f, residual = (t.unsqueeze(-1) for t in (size, f, residual))
    return lambda mu: f * mu + mu * (size / mu) ** q / q + BOUND * torch.relu(residual - mu)


SIZES = (0.0, 1e-3, 0.3, 1.0, 20.0)
COSTS = (0.0, 1e-3, 0.5, BOUND, 1.2 * BOUND, 10.0 * BOUND)
# Dense enough that some case lies just before, and some just after, each switch between formulas.
DENSE = tuple(torch.logspace(-4.0, 1.5, 40).tolist())
RESIDUALS = (-5.0, 0.0, *DENSE)
BETAS = (-4.0, -1e-3, 0.0, *DENSE)


@each_exponent
def test_primal_minimum_is_the_least_value_over_all_occupations(q):
    cost = PowerCost(q)
    size, f, residual = columns(SIZES, COSTS, RESIDUALS)
    # Where f = 0 the infimum is at mu = infinity, reached as mu^{1-q}: hence a grid up to 1e300.
    brute = lowest(primal_objective(size, f, residual, q), 1e-14, 1e300)
    at_zero = torch.where(size == 0.0, BOUND * residual.clamp_min(0.0), math.inf)
    found = cost.primal_minimum(two_dimensional(size), f, BOUND, residual)
    torch.testing.assert_close(found, torch.minimum(brute, at_zero), rtol=1e-8, atol=1e-12)


@each_exponent
def test_primal_occupation_attains_the_primal_minimum(q):
    cost = PowerCost(q)
    size, f, residual = columns(SIZES, COSTS, RESIDUALS)
    w = two_dimensional(size)
    mu = cost.primal_occupation(w, f, BOUND, residual)
    assert torch.equal(torch.isinf(mu), (f == 0.0) & (size > 0.0))
    assert (mu >= 0.0).all()
    known = torch.isfinite(mu)
    size, f, residual, mu = (t[known] for t in (size, f, residual, mu))
    perspective = torch.where(size > 0.0, mu * (size / mu) ** q / q, 0.0)
    attained = f * mu + perspective + BOUND * torch.relu(residual - mu)
    torch.testing.assert_close(attained, cost.primal_minimum(w[known], f, BOUND, residual), rtol=1e-10, atol=1e-12)


@each_exponent
def test_saddle_minimum_is_the_least_value_up_to_the_bound(q):
    cost = PowerCost(q)
    size, beta = columns(SIZES, BETAS)
    objective = lambda mu: beta.unsqueeze(-1) * mu + mu * (size.unsqueeze(-1) / mu) ** q / q
    brute = lowest(objective, 1e-14, BOUND)
    at_zero = torch.where(size == 0.0, 0.0, math.inf)
    found = cost.saddle_minimum(two_dimensional(size), beta, BOUND)
    torch.testing.assert_close(found, torch.minimum(brute, at_zero), rtol=1e-8, atol=1e-12)


@each_exponent
def test_saddle_occupation_attains_the_saddle_minimum_and_is_the_bound_where_beta_is_not_positive(q):
    cost = PowerCost(q)
    size, beta = columns(SIZES, BETAS)
    w = two_dimensional(size)
    mu = cost.saddle_occupation(w, beta, BOUND)
    assert ((mu >= 0.0) & (mu <= BOUND)).all()
    assert (mu[beta <= 0.0] == BOUND).all()
    attained = beta * mu + torch.where(size > 0.0, mu * (size / mu) ** q / q, 0.0)
    torch.testing.assert_close(attained, cost.saddle_minimum(w, beta, BOUND), rtol=1e-10, atol=1e-12)


@each_exponent
def test_conjugate_is_the_supremum_over_controls(q):
    """The best control points along `p`, so a search over its length suffices."""
    size = torch.tensor([0.0, 1e-3, 0.3, 1.0, 1.7], dtype=torch.float64)
    brute = -lowest(lambda r: r**q / q - size.unsqueeze(-1) * r, 1e-80, 1e8)
    torch.testing.assert_close(PowerCost(q).conjugate(two_dimensional(size)), brute, rtol=1e-8, atol=1e-14)


@each_exponent
@pytest.mark.parametrize("name", ["cost", "conjugate", "perspective", "primal", "saddle"])
def test_gradients_are_those_of_finite_differences(q, name):
    """At random arguments of order one; h^2 = 1e-12 times third derivatives stays below 1e-6."""
    cost = PowerCost(q)
    generator = torch.Generator().manual_seed(1)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)
    w, positive, signed, f = 2.0 * draw(400, 2) - 1.0, 0.1 + draw(400), 3.0 * draw(400) - 1.0, 2.0 * BOUND * draw(400)
    function, inputs = {
        "cost": (cost.cost, (w,)),
        "conjugate": (cost.conjugate, (w,)),
        "perspective": (cost.perspective, (w, positive)),
        "primal": (lambda w, beta: cost.primal_minimum(w, f, BOUND, beta), (w, signed)),
        "saddle": (lambda w, beta: cost.saddle_minimum(w, beta, BOUND), (w, signed)),
    }[name]
    exact_ones = value_and_gradients(function, *inputs)[1:]
    for exact, differenced in zip(exact_ones, central_differences(function, *inputs), strict=True):
        torch.testing.assert_close(exact, differenced, rtol=1e-5, atol=1e-6)


@each_exponent
def test_argmax_is_the_gradient_of_the_conjugate(q):
    cost = PowerCost(q)
    p = 2.0 * torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1.0
    (differenced,) = central_differences(cost.conjugate, p)
    torch.testing.assert_close(cost.argmax(p), differenced, rtol=1e-5, atol=1e-7)
    assert (cost.argmax(torch.zeros(1, 3)) == 0.0).all()


vectors = st.lists(st.floats(-5.0, 5.0), min_size=1, max_size=3).map(lambda v: torch.tensor([v], dtype=torch.float64))


@given(vectors, vectors, st.floats(1.05, 2.0))
def test_fenchel_young_inequality_holds_with_equality_at_the_argmax(u, p, q):
    cost = PowerCost(q)
    u = u.new_zeros(1, p.shape[1]).index_add_(1, torch.arange(u.shape[1]) % p.shape[1], u)
    above = cost.cost(u) + cost.conjugate(p)
    rounding = 1e-12 * (1.0 + float(above.abs()))
    assert float((u * p).sum()) <= float(above) + rounding
    best = cost.argmax(p)
    touching = cost.cost(best) + cost.conjugate(p) - (best * p).sum(dim=-1)
    assert abs(float(touching)) <= 1e-12 * (1.0 + float(cost.conjugate(p)))


def test_perspective_closes_at_zero_occupation():
    w = torch.tensor([[0.0, 0.0], [0.0, 1e-30]])
    assert PowerCost(1.5).perspective(w, torch.zeros(2)).tolist() == [0.0, math.inf]


TINY = (0.0, 1e-30, 1e-25, 1e-12, 1e-3, 1.0, 1e3)


@each_exponent
@pytest.mark.parametrize("name", ["cost", "conjugate", "argmax", "perspective", "primal", "saddle"])
def test_float32_agrees_with_float64_in_value_and_gradient_at_every_edge(q, name):
    """Wherever the float64 answers are of moderate size: no NaN, no false infinity, and nothing lost above 1e-12."""
    cost = PowerCost(q)
    function, axes = {
        "cost": (lambda w: cost.cost(w), (TINY,)),
        "conjugate": (lambda w: cost.conjugate(w), (TINY[:-1],)),
        "argmax": (lambda w: cost.argmax(w).sum(dim=-1), (TINY[:-1],)),
        "perspective": (cost.perspective, (TINY, TINY[1:])),
        "primal": (lambda w, f, beta: cost.primal_minimum(w, f.detach(), BOUND, beta), (TINY, TINY, (-1.0, *TINY))),
        "saddle": (lambda w, beta: cost.saddle_minimum(w, beta, BOUND), (TINY, (-1e3, -1.0, -1e-25, *TINY))),
    }[name]
    size, *rest = columns(*axes)
    for w in (torch.stack([size, 0.0 * size], dim=-1), torch.stack([size, -size], dim=-1)):
        inputs = [t.float() for t in (w, *rest)]
        found = [t.double() for t in value_and_gradients(function, *inputs)]
        truth = value_and_gradients(function, *(t.double() for t in inputs))
        huge = torch.stack([t.abs().reshape(len(w), -1).amax(dim=1) >= 1e15 for t in truth]).any(dim=0)
        for got, exact in zip(found, truth, strict=True):
            torch.testing.assert_close(got[~huge], exact[~huge], rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("q", [1.0, 0.5, 2.1, math.nan, "2", True])
def test_exponents_outside_their_range_are_refused(q):
    with pytest.raises(InputError, match="exponent"):
        PowerCost(q)
