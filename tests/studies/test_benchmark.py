"""What the benchmark measures and reports, the environment for reinforcement learning, and the paper's figures, all small."""

import dataclasses
import json
import math

import pytest
import torch

from ocp_torch.cli.compose import composed
from ocp_torch.control import policies
from ocp_torch.errors import InputError
from ocp_torch.fields import CONTROL_DENSITY, VALUE, Fields, SobolevField
from ocp_torch.gym.environment import ControlEnvironment, observe
from ocp_torch.problems import PROBLEMS
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.studies.benchmark import measure
from ocp_torch.studies.benchmark.contenders import KernelContender, NetworkContender, Recorder, RLContender, require_rl
from ocp_torch.studies.benchmark.contest import Contest
from ocp_torch.studies.benchmark.families import Family, by_dimension, exponent, joined, seconds_until, titles
from ocp_torch.studies.benchmark.measure import Curve, Judge, Point, due, median_and_spread, relative, tabulated
from ocp_torch.studies.benchmark.report import contest_table, reference
from ocp_torch.studies.paper import figures
from ocp_torch.studies.paper.reproduce import check, report, reproduce
from ocp_torch.studies.paper.runs import RECIPES, carry_out, circle, compare_with_exact
from support import zoo
from support.small import small as small_trainer

TINY = (
    "trainer.steps=6",
    "trainer.batch=8",
    "model.width=8",
    "model.depth=1",
    "kernel.seconds=0.01",
    "kernel.longest=40",
    "kernel.modes=6",
    "certificate.points=64",
    "certificate.replicates=2",
    "certificate.trajectories=4",
    "certificate.ascents=2",
    "certificate.tolerance=1e-2",
    "certificate.occupation_states=0",
    "certificate.stage.steps=2",
)


@pytest.fixture
def quick(monkeypatch):
    """Few states and trajectories for each measurement."""
    for name, count in dict(POINTS=128, TRAJECTORIES=16, ALONE=16, TABLE=2**10, TOLERANCE=1e-2).items():
        monkeypatch.setattr(measure, name, count)


def learned(problem, seed=0) -> Fields:
    """Smooth fields some way off the optimum."""
    make = lambda **form: SobolevField(modes=4, **form)
    fields = Fields.build(problem, (VALUE, CONTROL_DENSITY), make, 0).double()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for network in fields.networks.values():
            noise = torch.randn(network.coefficients.shape, generator=generator, dtype=torch.float64)
            network.coefficients.copy_(0.02 * noise)
    return fields.requires_grad_(False)


@pytest.mark.nightly
def test_the_judge_agrees_with_quadrature_on_a_dense_grid():
    problem, constants = circle()
    fields, n = learned(problem), 200_000
    numbers = Judge(problem, constants)(fields, policies.SADDLE)
    x = ((torch.arange(n, dtype=torch.float64) + 0.5) / n).unsqueeze(-1)
    samples = Samples.of(problem, x)
    generator, V = Generator.of(problem, samples), fields.value.jet(x)
    slack = generator.hjb_slack(V)
    assert numbers["F_M"] == pytest.approx(float((V.value - 2.0 * slack.clamp_min(0.0)).mean()), abs=2e-5)
    w, inflow = generator.control_inflow(fields.control_density)
    G = problem.control_cost.primal_minimum(w, samples.f, 2.0, inflow).mean()
    assert numbers["G"] == pytest.approx(float(G), abs=2e-5)
    assert numbers["F_M"] < problem.exact_optimum < numbers["G"] <= numbers["J"]
    assert min(numbers["value"], numbers["density"]) > problem.exact_optimum


@pytest.mark.nightly
def test_the_judge_knows_no_bound_by_a_guessed_M():
    problem = PROBLEMS["pendulum"](noise=1e-3)
    constants = resolve_constants(problem)
    fields = Fields({VALUE: zoo.rough_network(2, 3)})
    assert constants.needs_no_M
    assert "F_M" not in Judge(problem, constants)(fields, None, perf=False)
    assert "F_M" in Judge(problem, resolve_constants(problem, occupation_bound=9.0))(fields, None, perf=False)


@pytest.mark.nightly
def test_the_judge_finds_the_optimum_of_the_optimal_controller():
    """Simulated from a table of the policy; without drift, and with."""
    problem = zoo.build("circle rho=2")
    judge = Judge(problem, resolve_constants(problem))
    assert judge.performance(problem.exact_control) == pytest.approx(problem.exact_optimum, rel=5e-4)
    drifting = zoo.build("manufactured 1-d q=2")
    found = Judge(drifting, resolve_constants(drifting)).performance(drifting.exact_control)
    assert found == pytest.approx(drifting.exact_optimum, rel=5e-4)


class Exact(torch.nn.Module):
    def __init__(self, problem):
        super().__init__()
        self.forward = problem.exact_value


def test_beyond_one_dimension_the_value_is_a_control_variate(quick):
    """With `V*` itself nothing is left to simulate: sixteen starts give `OPT` as exactly as its mean is known."""
    problem = zoo.build("manufactured 2-d mu0")
    judge = Judge(problem, resolve_constants(problem))
    numbers = judge(Fields({VALUE: Exact(problem)}), None)
    assert numbers["value"] == pytest.approx(numbers["F_M"], rel=1e-6)
    alone = judge.performance(policies.ValuePolicy(problem, Exact(problem)))
    assert abs(alone - numbers["value"]) > 1e-4 * numbers["value"]


def test_a_table_of_a_law_is_periodic_and_of_second_order():
    policy = lambda x: torch.sin(2 * math.pi * x)
    x = torch.cat([zoo.states(zoo.Problem(1), 500), torch.tensor([[0.0], [1.0], [-0.25], [7.3]], dtype=torch.float64)])
    coarse, fine = ((tabulated(policy, n)(x) - policy(x)).abs().max() for n in (64, 256))
    assert fine < 1e-4
    assert coarse / fine == pytest.approx(16.0, rel=0.3)


def test_relative_needs_an_optimum():
    assert relative(1.1, 1.0) == pytest.approx(10.0)
    with pytest.raises(InputError, match="optimum"):
        relative(1.0, None)


def curve(name, seed, perfs, certified=None) -> Curve:
    points = [Point(10 * 2**i, 0.1 * i, {"value": p, "F_M": 0.9, "J": 1.2}) for i, p in enumerate(perfs)]
    return Curve(name, seed, points, certified)


def test_a_tolerance_counts_as_reached_once_it_is_never_left_again():
    assert curve("a", 0, [1.5, 1.005, 1.3, 1.009, 1.001]).first_within(0.01, 1.0).samples == 80
    assert curve("a", 0, [1.5, 1.005, 1.3]).first_within(0.01, 1.0) is None


def test_gaps_and_performances_of_a_point():
    point = Point(1, 0.0, {"value": 1.4, "density": 1.3, "F_M": 0.8, "shifted": 0.5, "J": 1.6, "G": 1.2})
    assert point.perf == 1.3
    assert point.gap == pytest.approx(0.5)
    assert Point(1, 0.0, {"F_M": 0.8}).gap == math.inf
    assert Point(1, 0.0, {"F_M": -0.1, "J": 1.0}).gap == math.inf
    assert Point(1, 0.0, {"value": math.nan}).perf == math.inf


def test_looks_grow_by_a_factor_and_spreads_are_medians():
    counts = due(10, per_decade=2)
    assert [next(counts) for _ in range(5)] == [10, 32, 100, 316, 1000]
    assert median_and_spread([3.0, 1.0, 2.0]) == (2.0, 1.0, 3.0)


def test_the_report_says_what_was_reached():
    curves = [curve("slow", s, [1.5, 1.2, 1.1]) for s in (0, 1)] + [curve("fast", 0, [1.5, 1.005, 1.004], 0.003)]
    text = contest_table(curves, 1.0)
    assert "not reached" in text
    assert "0.3 %" in text
    row = next(line for line in text.splitlines() if line.startswith("| fast"))
    assert "| 20 |" in row
    assert "1 % on Perf in the fewest samples: fast, 20." in text
    assert "slow" not in text.rsplit("\n\n", 1)[1]
    assert reference(curves, None) == (0.9, "the best lower bound found")
    assert "the best lower bound found" in contest_table(curves, None)


def family(dim, *curves, problem="torus", exact=1.0, **fields) -> Family:
    return Family(problem, dim, {"dim": dim, **fields}, exact, list(curves), {"torch": "1"})


def test_a_family_is_read_as_it_was_written_without_what_was_not_finite(tmp_path):
    written = family(2, curve("a", 0, [1.5, math.nan, 1.004], 0.003), curve("b", 1, [1.2]))
    written.write(tmp_path)
    read = Family.read(tmp_path / "curves.json")
    assert read.curves[1] == written.curves[1]
    assert read.curves[0].points[1].numbers == {"F_M": 0.9, "J": 1.2}
    assert (read.problem, read.dim, read.exact) == ("torus", 2, 1.0)
    assert (read.fields, read.versions) == ({"dim": 2}, {"torch": "1"})


def test_of_families_of_one_problem_the_first_one_s_curves_stay_and_others_join():
    new, old = curve("a", 0, [1.1]), curve("a", 0, [1.5])
    more = [curve("a", 1, [1.5]), curve("sac", 0, [2.0])]
    found = joined([family(3, new), family(1, old), family(3, old, *more), family(1, old, problem="arm")])
    assert titles(found) == ["torus, d = 1", "torus, d = 3", "arm, d = 1"]
    assert found[1].curves == [new, *more]


def test_a_problem_with_other_fields_is_another_problem_and_is_called_so():
    here, there = curve("a", 0, [1.1]), curve("a", 1, [1.5])
    families = joined([family(2, here, noise=0.0, seed=0), family(2, there, noise=0.01, seed=0)])
    assert [f.curves for f in families] == [[here], [there]]
    assert titles(families) == ["torus, d = 2, noise = 0.0", "torus, d = 2, noise = 0.01"]
    quick = Curve("a", 0, [Point(1, 1.0, {"value": 1.001, "F_M": 1.0})])
    assert by_dimension([family(d, quick, noise=0.1 * d) for d in (1, 2, 3)], 0.01) == {}


def test_seconds_until_a_gap_lie_on_a_power_law_between_points():
    """A gap of `seconds^-2` here, at 1, 3 and 9 s; none that rises again counts."""
    at = lambda s, gap: Point(1, s, {"value": 1.0 + gap, "F_M": 1.0})
    falling = Curve("a", 0, [at(s, s**-2.0) for s in (1.0, 3.0, 9.0)])
    for gap in (0.5, 0.05, 0.0124):
        assert seconds_until(falling, gap) == pytest.approx(gap**-0.5)
    assert seconds_until(falling, 2.0) == 1.0
    assert seconds_until(falling, 0.01) == math.inf
    assert seconds_until(Curve("a", 0, [*falling.points, at(10.0, 0.3)]), 0.05) == math.inf
    assert seconds_until(Curve("a", 0, [Point(1, 0.5, {"value": 1.0, "F_M": -1.0}), at(2.0, 0.01)]), 0.05) == 2.0


def test_the_cost_of_dimensions_has_an_exponent_where_there_are_three():
    reached = lambda seconds: Curve("a", 0, [Point(1, seconds, {"value": 1.001, "F_M": 1.0})])
    never = Curve("a", 1, [Point(1, 1.0, {"value": 2.0, "F_M": 1.0})])
    three = [family(d, reached(0.5 * d**1.5)) for d in (1, 4, 16)]
    ((name, pairs),) = by_dimension([*three, family(2, reached(1.0), problem="arm")], 0.01).items()
    assert name == "torus, a"
    assert exponent(pairs) == pytest.approx(1.5)
    assert by_dimension([*three[:2], family(16, reached(1.0), never)], 0.01) == {}


@pytest.mark.nightly
def test_what_was_measured_before_is_drawn_beside(tmp_path):
    for dim in (1, 2, 8):
        family(dim, curve("mlp dual", 0, [1.5, 0.9008]), problem="manufactured").write(tmp_path / str(dim))
    config = composed("benchmark", ["contenders=[]", f"beside=[{tmp_path}]"])
    assert Contest(config).run(tmp_path / "drawn") == []
    files = {path.name for path in (tmp_path / "drawn").iterdir()}
    assert files == {"benchmark.md", "benchmark.png", "dimensions.png"}
    text = (tmp_path / "drawn" / "benchmark.md").read_text()
    assert "## manufactured, d = 8" in text
    assert "CPU seconds to a simulated gap of 0.5 % as d^" in text


ODD = '{"problem": "a", "dim": "two", "fields": {}, "exact": null, "curves": [], "versions": {}}'


@pytest.mark.parametrize("content", [None, "{}", "[]", '{"curves": [{"points": 3}]}', '{"curves": [], "x": 1}', ODD])
def test_what_is_no_benchmark_is_not_drawn_beside(content, tmp_path):
    if content is not None:
        (tmp_path / "curves.json").write_text(content)
    with pytest.raises(InputError, match=str(tmp_path)):
        Contest(composed("benchmark", ["contenders=[]", f"beside=[{tmp_path}]"]))


def test_certified_gaps_are_held_against_the_paper_s_primal_dual():
    few = [curve("kernel pd", s, [1.1], gap) for s, gap in enumerate((0.1, 0.12, 0.2))]
    text = contest_table([*few, curve("a", 0, [1.1], 0.004)], 1.0)
    rows = {row.split(" | ")[0].strip("| "): row.split(" | ") for row in text.split("\n")}
    place = rows["contender"].index("times smaller")
    assert rows["a"][place] == "30"
    assert rows["kernel pd"][place] == "1"
    assert "nan" not in contest_table([curve("a", 0, [1.1], 0.004), curve("b", 0, [1.1])], 1.0)


@pytest.mark.nightly
def test_a_kernel_method_without_a_time_of_its_own_gets_that_of_the_longest_run_before_it(tmp_path, monkeypatch):
    given = []

    def run(self, seed, judge, certificate):
        given.append(getattr(self, "seconds", None))
        return Curve(self.name, seed, [Point(1, 7.0 + seed, {"F_M": 0.1, "value": 0.2})])

    for made in (KernelContender, NetworkContender):
        monkeypatch.setattr(made, "run", run)
    free = [o for o in TINY if "kernel.seconds" not in o]
    Contest(composed("benchmark", [*free, "seeds=[0,2]", "contenders=[kernel_pd,network_dual,kernel_dual]"])).run(
        tmp_path
    )
    assert given == [30.0, 30.0, None, None, 9.0, 9.0]
    Contest(composed("benchmark", [*TINY, "seeds=[0]", "contenders=[network_dual,kernel_dual]"])).run(tmp_path)
    assert given[6:] == [None, 0.01]


@pytest.mark.nightly
def test_a_whole_contest_in_small(tmp_path, quick):
    config = composed("benchmark", [*TINY, "seeds=[0,1]", "contenders=[kernel_dual,network_dual]"])
    curves = Contest(config).run(tmp_path)
    assert [(c.contender, c.seed) for c in curves] == [
        (name, seed) for name in ("kernel dual", "mlp dual") for seed in (0, 1)
    ]
    optimum = zoo.build("circle rho=2").exact_optimum
    for c in curves:
        assert c.points[-1].samples == {"kernel dual": 40, "mlp dual": 48}[c.contender]
        assert all(p.numbers.get("F_M", -1.0) < optimum < p.perf for p in c.points)
        assert [p.seconds for p in c.points] == sorted(p.seconds for p in c.points)
    assert curves[0].points[-1].numbers != curves[1].points[-1].numbers
    assert (tmp_path / "benchmark.png").stat().st_size > 1000
    assert (tmp_path / "benchmark.md").read_text().count("\n| ") == 3


def test_a_curve_ends_with_what_the_gauss_newton_steps_made():
    trainer, recorder = small_trainer("method=dual"), Recorder()
    trainer.fit(recorder)
    trainer.averaged_fields.value.head.weight.data.zero_()
    trainer.state.samples += 1000
    recorder.refined(trainer, None)
    recorder.refined(trainer, False)
    assert len({samples for samples, _, _ in recorder.kept}) == len(recorder.kept)
    assert recorder.kept[-1][0] == trainer.samples - 1000
    recorder.refined(trainer, True)
    assert recorder.kept[-1][0] == trainer.samples
    assert not recorder.kept[-1][2].value.head.weight.any()


def test_a_problem_with_drift_loses_the_kernel_primal_alone():
    config = composed("benchmark", [*TINY, "problem=manufactured", "problem.dim=1"])
    assert [m.name for m in Contest(config).contenders] == [
        "mlp dual",
        "mlp primal",
        "mlp pd",
        "kernel dual",
        "kernel pd",
    ]


@pytest.mark.parametrize(
    ("contender", "override", "words"),
    [
        ("kernel_duel", "seeds=[0]", "contenders"),
        ("", "seeds=[0]", "contenders"),
        ("kernel_dual", "seeds=[a]", "seeds"),
        ("kernel_dual", "seeds=3", "seeds"),
        ("kernel_dual", "kernel.step.dual=-1", "kernel.step.dual"),
        ("kernel_dual", "kernel.seconds=0", "kernel.seconds"),
        ("kernel_dual", "certificate.replicates=1", "certificate.replicates"),
        ("network_pd", "methods.pd.augmentation=-1", "augmentation"),
        ("network_pd", "trainer.batch=0", "trainer.batch"),
    ],
)
def test_wrong_fields_of_a_benchmark_are_refused_before_it_runs(contender, override, words):
    with pytest.raises(InputError, match=words):
        Contest(composed("benchmark", [*TINY, f"contenders=[{contender}]", override]))


def test_without_the_extra_packages_one_sentence_says_how_to_get_them(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gymnasium", None)
    with pytest.raises(InputError, match=r"\[rl\]"):
        require_rl()
    with pytest.raises(InputError, match=r"\[rl\]"):
        Contest(composed("benchmark", [*TINY, "contenders=[sac]"]))


def test_the_environment_pays_the_performance_of_a_controller():
    """The discounted return of `u*` from many starts is `-OPT`, up to the time step's error, which is of first order."""
    pytest.importorskip("gymnasium")
    pytest.importorskip("stable_baselines3")
    problem = zoo.build("circle rho=2")
    errors = []
    for dt in (0.2, 0.05):
        environment = ControlEnvironment(problem, 1.0, dt, horizon=4.0, seed=0)
        total, factor, episodes = 0.0, math.exp(-problem.discount * dt), 0
        for start in (torch.arange(40, dtype=torch.float64) + 0.5) / 40:
            observation, _ = environment.reset(seed=1)
            environment.x = start.reshape(1, 1)
            weight, done = 1.0, False
            while not done:
                observation, reward, ended, done, _ = environment.step(problem.exact_control(environment.x)[0].numpy())
                assert not ended
                total, weight = total + weight * reward, weight * factor
            episodes += 1
            assert environment.observation_space.contains(observation)
        errors.append(abs(-total / episodes / problem.exact_optimum - 1.0))
    assert errors[1] < 0.02
    assert errors[1] < 0.5 * errors[0]


def test_the_environment_starts_from_the_initial_density():
    pytest.importorskip("gymnasium")
    pytest.importorskip("stable_baselines3")
    problem = zoo.Swing()
    environment = ControlEnvironment(problem, 1.0, 0.1, horizon=1.0, seed=3)
    starts = torch.cat([environment.reset()[0] is not None and environment.x.clone() for _ in range(1500)])
    found = (2 * math.pi * (starts[:, 0] + 2 * starts[:, 1])).cos().mean()
    assert found == pytest.approx(0.25, abs=0.08)


@pytest.mark.nightly
def test_sac_runs_as_a_contender():
    pytest.importorskip("gymnasium")
    pytest.importorskip("stable_baselines3")
    problem, constants = circle()
    made = RLContender("sac", problem, 0.5, steps=150, time_step=0.1, horizon=4.0)
    result = made.run(0, Judge(problem, constants), None)
    assert result.points[-1].samples == 150
    assert problem.exact_optimum < result.points[-1].perf < math.inf


def test_observations_are_periodic():
    x = torch.tensor([[0.3, 0.9]], dtype=torch.float64)
    assert observe(x).shape == (4,)
    assert observe(torch.cat([x, x + 1.0])).shape == (2, 4)
    assert observe(x + 3.0) == pytest.approx(observe(x), abs=1e-6)


def small(name):
    return dataclasses.replace(RECIPES[name], looks=(20, 60), drawn=(20, 60), known={60: {}})


@pytest.mark.nightly
@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_in_small_gives_its_numbers_and_figures(name, quick):
    ticks = []
    history = carry_out(small(name), (0, 1), 8, ticks.append)
    assert sum(ticks) == 60
    wanted = {"dual": {"F_M", "value"}, "primal": {"G", "density"}, "pd": {"F_M", "G", "J", "value", "density"}}[
        RECIPES[name].method
    ]
    for numbers in history.numbers[60]:
        assert wanted <= set(numbers)
        assert numbers.get("F_M", -1.0) < 0.0 < min(numbers[n] for n in wanted - {"F_M"})
    assert history.numbers[60][0] != history.numbers[60][1]
    axis, distance = figures.evolution(history).axes
    assert len(axis.lines) - 1 == len(distance.lines) == len(wanted)
    assert distance.lines[-1].get_ydata()[-1] == pytest.approx(
        median_and_spread([m[history.recipe.numbers[-1]] for m in history.numbers[60]])[0]
    )
    panels = figures.iterates(history).axes
    assert len(panels) == (4 if name == "pd" else 2)
    assert all(len(panel.lines) == 3 for panel in panels)
    comparison = compare_with_exact(small(name), 40, 32, seed=0, windows=4, tick=ticks.append)
    assert sum(ticks) == 60 + 2 * 40
    assert all(0.0 < d < 1e-3 for d in comparison.differences.values())
    assert [n for n, _ in comparison.costs["exact"]] == [10, 20, 30, 40]
    (axis,) = figures.costs([comparison]).axes
    assert len(axis.lines) == 2
    text = report({name: history}, [comparison], (0, 1), 8)
    assert text.count(f"| {name} | 60 |") == len(wanted)


def test_the_exact_kernel_does_more_work_at_each_step_and_features_do_not():
    """Counted instead of timed: the numbers that enter one evaluation."""
    problem, constants = circle()
    from ocp_torch.fields.sobolev import SobolevFeatures
    from ocp_torch.studies.kernel.bernoulli import BernoulliKernel
    from ocp_torch.studies.kernel.expansions import FeatureExpansion, KernelExpansion
    from ocp_torch.studies.kernel.iterations import Iteration, step_sizes

    exact = Iteration(problem, "dual", constants, (0,), kernel=BernoulliKernel(2), capacity=60)
    truncated = Iteration(problem, "dual", constants, (0,), features=SobolevFeatures(1, modes=8))
    for n in (20, 40, 60):
        exact.advance(step_sizes(1e-3, 20))
        truncated.advance(step_sizes(1e-3, 20))
        (kernel,), (features,) = exact.expansions.values(), truncated.expansions.values()
        assert isinstance(kernel, KernelExpansion)
        assert isinstance(features, FeatureExpansion)
        assert kernel.coefficients[:, : kernel.known].size == 2 * n
        assert features.theta.size == 17


@pytest.mark.nightly
def test_a_whole_reproduction_in_small(tmp_path, monkeypatch, quick):
    for name in RECIPES:
        monkeypatch.setitem(RECIPES, name, small(name))
    reproduce(check({"seeds": [0], "modes": 8, "exact_steps": dict.fromkeys(RECIPES, 10)}), tmp_path)
    made = {path.stem for path in (tmp_path / "figures").glob("*.png")}
    each = {f"{name}_{kind}" for name in RECIPES for kind in ("performance", "iterates")}
    assert made == each | {"mu_star", "cost_per_step"}
    assert "CPU time per step" in (tmp_path / "numbers.md").read_text()
    assert set(json.loads((tmp_path / "numbers.json").read_text())["numbers"]) == set(RECIPES)


@pytest.mark.parametrize(
    ("change", "word"),
    [({"seeds": []}, "seeds"), ({"modes": 0}, "modes"), ({"exact_steps": {"dual": 0}}, "exact_steps")],
)
def test_wrong_fields_of_a_reproduction_are_refused(change, word):
    config = {"seeds": [0], "modes": 8, "exact_steps": dict.fromkeys(RECIPES, 1)}
    with pytest.raises(InputError, match=word):
        check({**config, **change})
