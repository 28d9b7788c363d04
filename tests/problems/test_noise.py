"""Noise in a problem: exact truth with it, the adjoint generator, divergences of `D`, and the limit without it."""

import pytest
import torch

from ocp_torch.errors import InputError
from ocp_torch.maths.jets import diffusion_divergences, jet
from ocp_torch.problems import Circle, Manufactured, Problem, Torus
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from support import zoo

EXACT = dict(rtol=1e-10, atol=1e-10)


def grid(dim, side):
    axis = torch.arange(side, dtype=torch.float64) / side
    return torch.cartesian_prod(*[axis] * dim).reshape(-1, dim)


@zoo.on(zoo.EXACT_NOISY)
def test_the_truth_solves_both_equations(problem):
    """`Q = 0` for `V*` and `r = 0` for `(w*, mu*)`, at every state; `f >= 0`; and `OPT` is the mean of `V* mu0`."""
    x = zoo.states(problem, 200)
    samples = Samples.of(problem, x)
    L, zero = Generator.of(problem, samples), torch.zeros(len(x), dtype=torch.float64)
    torch.testing.assert_close(L.hjb_slack(L.jet(problem.exact_value)), zero, **EXACT)
    w = lambda y: problem.exact_occupation(y).unsqueeze(-1) * problem.exact_control(y)
    _, inflow = L.control_inflow(w)
    mu, outflow = L.occupation_outflow(lambda y: problem.exact_occupation(y).log())
    torch.testing.assert_close(outflow, inflow, **EXACT)
    same, carried, _ = L.drift_flux(problem.exact_occupation)
    torch.testing.assert_close(same + carried / problem.discount, outflow, **EXACT)
    assert bool((samples.f > -1e-6).all())
    if problem.dim < 3:
        x = grid(problem.dim, 64)
        value = (problem.exact_value(x) * problem.initial_density(x)).mean()
        torch.testing.assert_close(float(value), problem.exact_optimum, **EXACT)


@zoo.on(zoo.NOISY)
def test_the_generator_is_that_of_differences(problem):
    """`L^0 V = grad V . a + sum_k sigma_k . hess V . sigma_k / 2`, by central differences of second order."""
    x, V, step = zoo.states(problem, 64), zoo.rough_network(problem.dim, seed=2, size=0.3), 1e-4
    samples = Samples.of(problem, x)
    L = Generator.of(problem, samples)
    along = (V(x + step * samples.a) - V(x - step * samples.a)) / (2.0 * step)
    bent = sum(V(x + step * s) + V(x - step * s) - 2.0 * V(x) for s in samples.noise.unbind(-1)) / (2.0 * step**2)
    torch.testing.assert_close(L.uncontrolled(L.jet(V)), along + bent, rtol=1e-4, atol=1e-4)


@zoo.on(("noisy 1-d", "noisy 2-d sigma(x)", "noisy swing"))
def test_generator_and_residual_are_adjoint(problem):
    """`E[-V mu + (L^0 V mu + grad V . B w) / rho] = E[V (r - mu0)]` for random fields: integration by parts; and the flux has
    the divergence that is carried away."""
    samples = Samples.of(problem, grid(problem.dim, 128))
    L = Generator.of(problem, samples)
    V, log_mu = (zoo.rough_network(problem.dim, seed, size=0.3) for seed in (5, 6))
    w = zoo.rough_network(problem.dim, seed=7, outputs=problem.control_dim)
    (_, inflow), (mu, outflow) = L.control_inflow(w), L.occupation_outflow(log_mu)
    charged = L.multiplier_term(L.jet(V), mu, w(samples.x)).mean()
    torch.testing.assert_close(charged, (V(samples.x) * (inflow - outflow - samples.mu0)).mean(), rtol=1e-6, atol=1e-6)
    same, carried, flux = L.drift_flux(lambda y: log_mu(y).exp())
    torch.testing.assert_close(same + carried / problem.discount, outflow)
    torch.testing.assert_close(L.occupation_flux(log_mu)[2], flux)
    along = (flux * L.jet(V).gradient).sum(dim=-1).mean()
    torch.testing.assert_close(-along, (V(samples.x) * carried).mean(), rtol=1e-6, atol=1e-6)


@zoo.on(zoo.NOISY)
def test_divergences_of_the_noise(problem):
    """Closed forms against autograd, and that against differences of `D`."""
    x, step, d = zoo.states(problem, 40), 1e-4, problem.dim
    div_D, div_div_D = problem.noise_divergences(x)
    for found, expected in zip(diffusion_divergences(problem.noise, x), (div_D, div_div_D), strict=True):
        torch.testing.assert_close(found, expected, **EXACT)
    axes = step * torch.eye(d, dtype=torch.float64)
    D = lambda y: 0.5 * problem.noise(y) @ problem.noise(y).mT
    first = sum((D(x + axes[j]) - D(x - axes[j]))[:, :, j] for j in range(d)) / (2.0 * step)
    torch.testing.assert_close(div_D, first, rtol=1e-5, atol=1e-6)
    rows = lambda y: problem.noise_divergences(y)[0]
    second = sum((rows(x + axes[j]) - rows(x - axes[j]))[:, j] for j in range(d)) / (2.0 * step)
    torch.testing.assert_close(div_div_D, second, rtol=1e-5, atol=1e-6)


def test_without_noise_nothing_is_there():
    for problem in (Circle(), Manufactured(state_dependent_noise=True), zoo.build("swing")):
        x = zoo.states(problem, 3)
        samples = Samples.of(problem, x)
        assert problem.noise(x) is samples.noise is samples.div_D is samples.div_div_D is None
        assert not problem.noisy


def test_a_little_noise_changes_little():
    """Data, generator and adjoint at noise that tends to 0 are those without it."""
    x = zoo.states(Problem(2), 50)
    V = zoo.rough_network(2, seed=1)
    without, little = Manufactured(), Manufactured(noise=1e-12)
    of = {p: (Samples.of(p, x), Generator.of(p, Samples.of(p, x))) for p in (without, little)}
    for name in ("f", "a", "B", "mu0", "div_a"):
        torch.testing.assert_close(getattr(of[without][0], name), getattr(of[little][0], name), rtol=1e-8, atol=1e-8)
    Q, Q_noisy = (L.hjb_slack(L.jet(V)) for _, L in of.values())
    torch.testing.assert_close(Q, Q_noisy, rtol=1e-6, atol=1e-6)
    out, out_noisy = (L.occupation_outflow(V)[1] for _, L in of.values())
    torch.testing.assert_close(out, out_noisy, rtol=1e-6, atol=1e-6)


def test_relabelled_coordinates_give_the_same():
    """The slack of `V` with coordinates exchanged, on a problem whose noise is exchanged as well."""
    x, V, flipped = zoo.states(Problem(2), 30), zoo.rough_network(2, seed=1), [1, 0]

    class Plain(Problem):
        def state_cost(self, x):
            return 1.0 + (6.0 * torch.pi * x).cos().mean(dim=-1)

    there, back = Plain(2, noise=[0.01, 0.3]), Plain(2, noise=[0.3, 0.01])
    slack = lambda p, at, f: (lambda L: L.hjb_slack(L.jet(f)))(Generator.of(p, Samples.of(p, at)))
    exchanged = lambda y: V(y[:, flipped])
    torch.testing.assert_close(slack(there, x, V), slack(back, x[:, flipped], exchanged), **EXACT)


@pytest.mark.parametrize("noise", [0.01, [0.01], [0.0]])
def test_a_problem_with_noise_can_be_made_again(noise):
    problem = Circle(noise=noise)
    again = Circle(**problem.parameters)
    assert problem.parameters["noise"] == noise
    assert again.diffusion == problem.diffusion
    assert Manufactured(drift=0.4).parameters["drift"] == 0.4


@pytest.mark.parametrize("noise", [-0.1, [0.1, -0.1], [0.1], "much", float("nan"), None])
def test_wrong_noise_is_named(noise):
    with pytest.raises(InputError, match=r"problem\.noise"):
        Torus(dim=2, noise=noise)


def test_noise_is_in_the_precision_of_the_states():
    problem = Torus(dim=2, noise=0.01)
    assert problem.noise(zoo.states(problem, 3, dtype=torch.float32)).dtype == torch.float32
    sigma = problem.noise(zoo.states(problem, 3))
    torch.testing.assert_close(0.5 * sigma @ sigma.mT, 0.01 * torch.eye(2, dtype=torch.float64).expand(3, 2, 2))
    assert jet(lambda y: y.square().sum(-1), zoo.states(problem, 3), sigma).curvature.tolist() == pytest.approx(
        [0.04] * 3
    )
