"""Controllers and densities at the exact truth are the exact ones, whichever way they are made of the fields."""

import pytest
import torch

from ocp_torch.control.policies import (
    CLOSED,
    NETWORK,
    SADDLE,
    ValuePolicy,
    density_policy,
    occupation_density,
    trained_policies,
    zero_policy,
)
from ocp_torch.fields import Fields
from ocp_torch.maths.jets import control_flux_divergence
from ocp_torch.problems.closed_loop import ClosedLoop
from ocp_torch.problems.constants import resolve_constants
from support import zoo
from support.exact import ROUNDING
from support.formulas import Exactly


def exact_fields(problem) -> Fields:
    flux = lambda x: problem.exact_occupation(x).unsqueeze(-1) * problem.exact_control(x)
    fields = {
        "value": problem.exact_value,
        "control_density": flux,
        "log_occupation": lambda x: mu_of(problem)(x).log(),
    }
    return Fields({name: Exactly(formula) for name, formula in fields.items()})


def mu_of(problem):
    return lambda x: problem.exact_occupation(x).clamp_min(1e-300)


@zoo.on((*zoo.EXACT, *zoo.LIMITED))
def test_the_controller_of_the_exact_value_is_the_exact_one(problem):
    x = zoo.states(problem, 500, off_kinks=True)
    torch.testing.assert_close(ValuePolicy(problem, problem.exact_value)(x), problem.exact_control(x), **ROUNDING)


@zoo.on((*zoo.SMOOTH, *zoo.LIMITED))
def test_its_own_divergence_is_that_of_reverse_passes(problem):
    x, value = zoo.states(problem, 300), zoo.rough_network(problem.dim, 1)
    _, B, _, div_B = problem.vector_fields(x)
    policy = ValuePolicy(problem, value)
    u, flux = policy.flux_divergence(x, B, div_B)
    expected_u, expected = control_flux_divergence(policy, x, B, div_B)
    torch.testing.assert_close(u, expected_u)
    torch.testing.assert_close(flux, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    loop = ClosedLoop(problem, policy)
    _, _, divergence, _ = loop.vector_fields(x)
    torch.testing.assert_close(divergence, problem.drift_divergence(x) + expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", ["manufactured 2-d B(x)", "manufactured 2-d q=2"])
def test_and_so_it_is_at_one_state_alone(name):
    problem = zoo.build(name)
    policy, x = ValuePolicy(problem, zoo.rough_network(problem.dim, 1)), zoo.states(problem, 5)
    _, B, _, div_B = problem.vector_fields(x)
    alone = [policy.flux_divergence(x[k : k + 1], B[k : k + 1], div_B[k : k + 1])[1] for k in range(len(x))]
    torch.testing.assert_close(torch.cat(alone), control_flux_divergence(policy, x, B, div_B)[1])


KINDS = [(CLOSED, n) for n in zoo.KINKED] + [(k, n) for n in (*zoo.SMOOTH, *zoo.LIMITED) for k in (SADDLE, NETWORK)]


@pytest.mark.parametrize(("kind", "name"), KINDS)
def test_the_density_of_the_exact_fields_is_the_exact_one_and_so_is_its_controller(kind, name):
    """Lemmas 2 and 3 at the truth; in the latter `mu` is determined where something is controlled."""
    problem = zoo.build(name)
    x, fields, constants = zoo.states(problem, 500, off_kinks=True), exact_fields(problem), resolve_constants(problem)
    u = problem.exact_control(x)
    moved = u.norm(dim=-1) > 1e-3
    mu = occupation_density(kind, problem, fields, constants)
    torch.testing.assert_close(mu(x)[moved], problem.exact_occupation(x)[moved], rtol=1e-6, atol=1e-9)
    found = trained_policies(kind, problem, fields, constants)
    assert set(found) == {"value", "density"}
    torch.testing.assert_close(found["density"](x)[moved], u[moved], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", [CLOSED, SADDLE, NETWORK])
def test_a_controller_from_w_and_mu_asks_for_w_once(kind):
    problem, asked = zoo.build("torus 2-d chain"), []
    fields = exact_fields(problem)
    fields.control_density.register_forward_hook(lambda *_: asked.append(kind))
    trained_policies(kind, problem, fields, resolve_constants(problem))["density"](zoo.states(problem, 5))
    assert asked == [kind]


def test_where_there_is_no_mass_or_mass_without_end_nothing_is_controlled():
    problem = zoo.build("manufactured 2-d q=2")
    x = zoo.states(problem, 3)
    mu = torch.tensor([0.0, torch.inf, 2.0], dtype=torch.float64)
    u = density_policy(lambda x: (torch.ones_like(x), mu), problem.control_cost)(x)
    assert u.tolist() == [[0.0, 0.0], [0.0, 0.0], [0.5, 0.5]]
    assert (zoo.build("manufactured 3-d m=2").control_dim, 0.0) == (
        zero_policy(zoo.build("manufactured 3-d m=2"))(torch.rand(2, 3)).shape[1],
        float(zero_policy(problem)(x).abs().max()),
    )
