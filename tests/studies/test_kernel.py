"""The paper's iterations: exact kernel, truncated features, autograd and the trainer must all make the same steps."""

import numpy as np
import pytest
import torch

from ocp_torch.cli.compose import composed
from ocp_torch.errors import InputError
from ocp_torch.fields import CONTROL_DENSITY, VALUE, Fields
from ocp_torch.fields.sobolev import SobolevFeatures, SobolevField
from ocp_torch.objectives import METHODS, Phase
from ocp_torch.problems import Manufactured
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.samples import Samples
from ocp_torch.runs.build import build_trainer
from ocp_torch.steppers import schedule_maker
from ocp_torch.studies.benchmark.contenders import OCCUPATION
from ocp_torch.studies.benchmark.measure import Judge, relative
from ocp_torch.studies.kernel.bernoulli import BernoulliKernel, bernoulli_polynomial
from ocp_torch.studies.kernel.iterations import Iteration, step_sizes
from ocp_torch.studies.kernel.rules import RULES, Datum
from ocp_torch.studies.paper.runs import circle
from ocp_torch.training.monitor import Observer
from support import zoo


class Driftless(zoo.Swing):
    """No drift, `q = 1.5`, a state-dependent column of `B` with divergence, and a state cost up to 2."""

    drift = zoo.Problem.drift


class Costly(Driftless):
    """Where `f > C_V`, losing mass is cheaper than keeping it."""

    state_cost_bound = 2.0


PROBLEMS = {
    "circle": lambda: zoo.build("circle rho=2"),
    "torus": lambda: zoo.build("torus 2-d chain"),
    "driftless": Driftless,
    "swing": zoo.Swing,
    "two controls": lambda: zoo.build("manufactured 3-d m=2 B(x) q=1.5"),
    "nearly linear": lambda: Manufactured(dim=2, exponent=1.2, initial_contrast=0.5),
}
PLAIN = {"dual": dict(residual=0.0), "primal": {}, "pd": dict(augmentation=0.0)}


def test_bernoulli_polynomials_are_the_known_ones():
    assert [float(c) for c in bernoulli_polynomial(4)] == pytest.approx([-1 / 30, 0.0, 1.0, -2.0, 1.0])
    assert [float(c) for c in bernoulli_polynomial(1)] == [-0.5, 1.0]


@pytest.mark.parametrize("regularity", [2, 3, 5])
def test_the_kernel_is_its_fourier_series_and_has_its_derivatives(regularity):
    t = np.linspace(-1.3, 1.7, 61) + 0.011
    w = np.arange(1, 3001)[:, None]
    series = 1.0 + 2.0 * (w ** (-2.0 * regularity) * np.cos(2 * np.pi * w * t)).sum(axis=0)
    kernel, h = BernoulliKernel(regularity), 1e-6
    value, first, second = kernel.derivatives(t)
    np.testing.assert_allclose(value, series, atol=1e-9)
    up, down = kernel.derivatives(t + h), kernel.derivatives(t - h)
    np.testing.assert_allclose((up[0] - down[0]) / (2 * h), first, atol=1e-5)
    np.testing.assert_allclose((up[1] - down[1]) / (2 * h), second, atol=1e-3)


def test_the_papers_kernel():
    """`1 - (2 pi)^4 / 24 B_4({x - y})`."""
    t = np.linspace(0.0, 1.0, 11)
    B4 = t**4 - 2 * t**3 + t**2 - 1 / 30
    np.testing.assert_allclose(BernoulliKernel(2).derivatives(t % 1.0)[0], 1 - (2 * np.pi) ** 4 / 24 * B4, atol=1e-12)


def test_mixed_derivatives_of_the_product_kernel_match_finite_differences():
    kernel, h = BernoulliKernel(3), 1e-5
    x, y = (zoo.states(zoo.Problem(2), 20, seed).numpy() for seed in (0, 1))
    jets = kernel.jets(x, y)
    for i in range(2):
        step = h * np.eye(2)[i]
        along_x = (kernel.jets(x + step, y) - kernel.jets(x - step, y)) / (2 * h)
        along_y = (kernel.jets(x, y + step) - kernel.jets(x, y - step)) / (2 * h)
        np.testing.assert_allclose(jets[:, i + 1, 0], along_x[:, 0, 0], atol=1e-4)
        np.testing.assert_allclose(jets[:, 0, i + 1], along_y[:, 0, 0], atol=1e-4)
        for j in range(2):
            np.testing.assert_allclose(jets[:, j + 1, i + 1], along_y[:, j + 1, 0], atol=1e-2)


@pytest.mark.parametrize("regularity", [1, 9, 2.5])
def test_kernels_without_a_closed_form_to_trust_are_refused(regularity):
    with pytest.raises(InputError, match="regularity"):
        BernoulliKernel(regularity)


def random_fields(problem, names, seed, size) -> Fields:
    fields = Fields.build(problem, names, lambda **form: SobolevField(modes=3, **form), 0).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for network in fields.networks.values():
            shape = network.coefficients.shape
            network.coefficients.copy_(size * torch.randn(shape, generator=generator, dtype=torch.float64))
    return fields


@pytest.mark.parametrize("method", RULES)
@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("tight", [False, True])
def test_a_rule_is_minus_the_gradient_of_the_package_s_loss(method, name, tight):
    """Of a mean over samples, at quiet and at wild fields; ``tight`` puts `C_V` below some `f` and `M` near 0."""
    problem = PROBLEMS[name]()
    if method == "primal" and not problem.driftless:
        return
    given = dict(occupation_bound=0.3, value_bound=0.1) if tight else dict(occupation_bound=2.0, value_bound=2.0)
    constants = resolve_constants(problem, **given)
    rule = RULES[method](problem, constants)
    objective = METHODS[method](problem, **PLAIN[method])
    moving = 0
    for seed, size in enumerate((0.03, 0.3, 3.0)):
        fields = random_fields(problem, rule.fields, seed, size)
        x = zoo.states(problem, 12, seed)
        samples = Samples.of(problem, x)
        features = next(iter(fields.networks.values())).features
        jets = features.jets(x).numpy()
        columns = (samples.x, samples.f, samples.a, samples.B, samples.mu0, samples.div_B)
        datum = Datum(*(c.numpy() for c in columns), jets)
        theta = {n: np.atleast_2d(f.coefficients.detach().numpy()).T for n, f in fields.networks.items()}
        step = rule(datum, {n: jets @ t for n, t in theta.items()})
        losses = objective.losses(fields, samples, Phase(constants))
        for player, names in objective.players.items():
            parameters = [fields.networks[n].coefficients for n in names]
            gradients = torch.autograd.grad(losses[player], parameters, retain_graph=True)
            for n, gradient in zip(names, gradients, strict=True):
                moved = np.einsum("naf,nao->of", jets, step[n]).reshape(gradient.shape) / len(x)
                np.testing.assert_allclose(moved, -gradient.numpy(), rtol=1e-7, atol=1e-9)
        moving += int((np.abs(step[rule.fields[-1]]).sum(axis=(1, 2)) > 1e-12).sum())
    assert moving > 0


def test_the_primal_rule_meets_all_of_its_branches():
    """Free mass, mass at the bound, and mass that is given up, each at some state of the test above."""
    problem = Costly()
    constants = resolve_constants(problem, occupation_bound=2.0, value_bound=0.5)
    fields, x = random_fields(problem, (CONTROL_DENSITY,), 1, 0.3), zoo.states(problem, 200)
    samples = Samples.of(problem, x)
    jets = fields.control_density.features.jets(x).numpy()
    columns = (samples.x, samples.f, samples.a, samples.B, samples.mu0, samples.div_B)
    theta = fields.control_density.coefficients.detach().numpy().T
    step = RULES["primal"](problem, constants)(
        Datum(*(c.numpy() for c in columns), jets), {CONTROL_DENSITY: jets @ theta}
    )
    push = np.abs(step[CONTROL_DENSITY][:, 1:]).max(axis=(1, 2)) / np.abs(samples.B.numpy()).max(axis=(1, 2))
    push *= problem.discount
    free, kept, lost = push < 1e-12, (push > 1e-6) & (push < 0.5 - 1e-6), push > 0.5 - 1e-9
    assert free.sum() > 10
    assert kept.sum() > 10
    assert lost.sum() > 10


def iterations(problem, method, steps, modes, radius=None, regularity=2, seeds=(0, 1), size=2e-3):
    """The exact iteration and its truncations to each of ``modes``, after the same steps on the same samples."""
    constants = resolve_constants(problem, occupation_bound=2.0, value_bound=2.0)
    sizes = step_sizes(size, steps)
    exact = Iteration(
        problem, method, constants, seeds, kernel=BernoulliKernel(regularity), capacity=2 * steps, radius=radius
    )
    exact.advance(sizes)
    truncated = []
    for count in modes:
        features = SobolevFeatures(problem.dim, regularity, modes=count)
        truncated.append(Iteration(problem, method, constants, seeds, features=features, radius=radius))
        truncated[-1].advance(sizes)
    return exact, truncated


def distance(exact: Iteration, truncated: Iteration) -> float:
    """The largest difference of the averaged fields on a grid."""
    dim = exact.problem.dim
    grid = zoo.states(exact.problem, 100).numpy()[None] if dim > 1 else np.linspace(0, 1, 101)[None, :, None]
    found = 0.0
    for name, expansion in exact.expansions.items():
        values = expansion.at(grid, average=True)[:, :, 0]
        for run in range(len(values)):
            network = truncated.fields(run).networks[name]
            here = network(torch.from_numpy(grid[0])).numpy().reshape(values[run].shape)
            found = max(found, float(np.abs(here - values[run]).max()))
    return found


@pytest.mark.parametrize("regularity", [2, 3])
@pytest.mark.parametrize("method", RULES)
def test_truncated_features_converge_to_the_exact_kernel(method, regularity):
    """The tail that is left out of `d_x K` is of order `K^(2 - 2 s)`: on a log scale the slope is at least that."""
    problem = zoo.build("circle rho=2")
    exact, truncated = iterations(problem, method, 150, (8, 16, 32, 64), regularity=regularity)
    errors = np.array([distance(exact, t) for t in truncated])
    slope = np.polyfit(np.log([8, 16, 32, 64]), np.log(errors), 1)[0]
    assert slope < -(2 * regularity - 2) + 0.4
    assert errors[-1] < 1e-5


@pytest.mark.parametrize("method", ["dual", "primal", "pd"])
def test_both_forms_agree_in_two_dimensions_with_projections(method):
    """A ball small enough to be met; ``B(x)``, `q = 1.5`, and for dual and pd drift."""
    problem = Driftless() if method == "primal" else zoo.Swing()
    radius = 0.02
    exact, (coarse, fine) = iterations(problem, method, 60, (8, 48), radius, regularity=4)
    scale = max(np.abs(e.at(zoo.states(problem, 50).numpy()[None])).max() for e in exact.expansions.values())
    assert distance(exact, fine) < 1e-5 * scale
    assert distance(exact, fine) < 0.1 * distance(exact, coarse)
    met = 0
    for name, expansion in fine.expansions.items():
        norms = np.sqrt(np.square(expansion.theta).sum(axis=(1, 2)))
        np.testing.assert_allclose(np.sqrt(exact.expansions[name].squared_norm), norms, rtol=1e-5)
        assert (norms <= radius * (1 + 1e-12)).all()
        met += int((norms > radius * (1 - 1e-9)).any())
    assert met


def test_the_norm_kept_up_to_date_is_that_of_the_gram_matrix():
    exact, _ = iterations(zoo.Swing(), "pd", 20, (), radius=0.05)
    for expansion in exact.expansions.values():
        n = expansion.known
        x, c = expansion.x[0, :n], expansion.coefficients[0, :n]
        gram = expansion.kernel.jets(x[:, None], x[None])
        squared = np.einsum("kao,klab,lbo->", c, gram, c)
        assert expansion.squared_norm[0] == pytest.approx(squared, rel=1e-8)


def test_runs_side_by_side_are_the_runs_one_by_one():
    problem, constants = circle()
    both = Iteration(problem, "pd", constants, (3, 8), features=SobolevFeatures(1, modes=8))
    both.advance(step_sizes(1e-2, 50))
    for run, seed in enumerate((3, 8)):
        alone = Iteration(problem, "pd", constants, (seed,), features=SobolevFeatures(1, modes=8))
        alone.advance(step_sizes(1e-2, 50))
        for name in (VALUE, CONTROL_DENSITY):
            np.testing.assert_allclose(
                alone.expansions[name].theta[0], both.expansions[name].theta[run], rtol=1e-12, atol=1e-15
            )
    assert (both.n, both.samples) == (50, 100)


@pytest.mark.parametrize("method", RULES)
def test_the_trainer_makes_the_paper_s_steps(method):
    """`experiment=paper_*` through the trainer and torch.optim, and the iteration here: one algorithm."""
    steps = 40
    config = composed("train", [f"experiment=paper_{method}", f"trainer.steps={steps}", "model.modes=12", "seed=5"])
    trainer = build_trainer(config)
    trainer.fit(Observer())
    features = SobolevFeatures(1, modes=12)
    iteration = Iteration(trainer.problem, method, trainer.constants, (5,), features=features)
    iteration.advance(step_sizes(config["optimizer"]["lr"], steps))
    for name, network in iteration.fields(0).networks.items():
        theta = iteration.expansions[name].theta[0].T.reshape(network.coefficients.shape)
        last = trainer.fields.networks[name].coefficients.detach()
        np.testing.assert_allclose(last.numpy(), theta, rtol=1e-9, atol=1e-14)
        # torch.optim.swa_utils takes its weights 1/n in single precision.
        learned = trainer.averaged_fields.networks[name].coefficients
        torch.testing.assert_close(learned.detach(), network.coefficients, rtol=1e-5, atol=1e-9)
        assert learned.abs().max() > 1e-4
    assert trainer.samples == iteration.samples


@pytest.mark.parametrize(("kind", "options"), [("constant", {}), ("decay", dict(decay=0.5, every=3)), ("power", {})])
def test_step_sizes_are_the_schedules_learning_rates(kind, options):
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=0.3)
    schedule = schedule_maker(kind, 10, **options)(optimizer)
    rates = []
    for _ in range(10):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    np.testing.assert_allclose(step_sizes(0.3, 10, kind, **options), rates)


def test_the_theorems_step_sizes():
    np.testing.assert_allclose(step_sizes(2.0, 1000, "horizon", exponent=2 / 3), np.full(1000, 0.02))
    np.testing.assert_allclose(step_sizes(2.0, 4, "power", exponent=0.5), 2.0 / np.sqrt([1, 2, 3, 4]))
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=2.0)
    schedule_maker("horizon", 1000, exponent=2 / 3)(optimizer, 0.0)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.02)
    with pytest.raises(InputError, match="kind"):
        step_sizes(1.0, 3, "cosine")


def test_the_primal_with_drift_is_refused():
    problem = zoo.Swing()
    with pytest.raises(InputError, match="drift"):
        Iteration(problem, "primal", resolve_constants(problem), (0,), features=SobolevFeatures(2, modes=2))


@pytest.mark.nightly
def test_the_paper_s_dual_and_primal_after_five_and_twenty_thousand_samples():
    """Wide enough for any seed: eight seeds spread over 5.0-5.6 and 2.4-2.6 % (`F_M`), 0.37-0.75 and 0.12-0.23 % (`G`)."""
    problem, constants = circle()
    judge = Judge(problem, constants)
    wanted = {"dual": ("F_M", (-6.2, -4.4), (-3.0, -2.1)), "primal": ("G", (0.2, 1.1), (0.08, 0.32))}
    for method, size in (("dual", 5e-4), ("primal", 2e-3)):
        number, *ranges = wanted[method]
        iteration = Iteration(problem, method, constants, (11, 12), features=SobolevFeatures(1, modes=64))
        for steps, (low, high) in zip((5000, 15000), ranges, strict=True):
            iteration.advance(step_sizes(size, steps))
            for run in range(2):
                fields = iteration.fields(run)
                found = relative(judge(fields, OCCUPATION[method], perf=False)[number], problem.exact_optimum)
                assert low < found < high


@pytest.mark.nightly
def test_the_paper_s_primal_dual_squeezes_the_optimum():
    """Weak duality at every look, and a gap that shrinks by the step."""
    problem, constants = circle()
    judge, gaps = Judge(problem, constants), []
    iteration = Iteration(problem, "pd", constants, (21,), features=SobolevFeatures(1, modes=64))
    for steps in (2000, 4000, 10000):
        iteration.advance(step_sizes(1e-3, steps, "decay"))
        numbers = judge(iteration.fields(0), OCCUPATION["pd"], perf=False)
        assert numbers["F_M"] < problem.exact_optimum < numbers["G"] <= numbers["J"]
        gaps.append(numbers["G"] - numbers["F_M"])
    assert gaps[0] > 1.5 * gaps[1] > 2.0 * gaps[2]
