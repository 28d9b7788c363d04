"""A bound is one class and one line in a list: table, file, gap, checks and the benchmark's columns follow."""

import json
from functools import partial

import pytest
import torch

from ocp_torch import certify
from ocp_torch.certificate import (
    BOUNDS,
    LOWER,
    PERFORMANCE,
    UPPER,
    Bound,
    CertificateSettings,
    Run,
    StageSettings,
    Trained,
    bounds,
    certify_fields,
    table,
)
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.problems import Manufactured
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.problems.needs import GIVEN, GUESSED, Need
from ocp_torch.studies.benchmark.measure import Curve, Judge, Point
from ocp_torch.studies.benchmark.report import contest_table

PROBLEM = Manufactured(dim=1)
OPT = PROBLEM.exact_optimum
CHEAP = CertificateSettings(
    points=256,
    replicates=4,
    trajectories=8,
    ascents=4,
    occupation_states=0,
    mollify=False,
    tolerance=1e-2,
    stage=StageSettings(steps=0),
)


class Toy(Bound):
    """So much times the optimum of the problem at hand."""

    label = "a toy"

    def __init__(self, side: str, part: float, basis: str = GIVEN, holds: bool = True, name: str = "toy") -> None:
        self.name, self.side, self.part = name, side, part
        self.need = Need("toy", basis, "the toy is right", holds)

    def needs(self, assumptions):
        return (self.need,)

    def evaluate(self, context):
        return Estimate(self.part * OPT, 0.0)


@pytest.fixture
def listed():
    """Lists a bound, until the test is over."""
    before = list(BOUNDS)
    yield BOUNDS.append
    BOUNDS[:] = before


class Rough(torch.nn.Module):
    """Off the truth by so much that its own bounds leave room."""

    def __init__(self) -> None:
        super().__init__()
        self.size = torch.nn.Parameter(torch.tensor(0.2 * OPT))

    def forward(self, x):
        return PROBLEM.exact_value(x) + self.size * (2.0 * torch.pi * x[:, 0]).sin()


def certificate():
    trained = Trained(Fields({"value": Rough()}), None, partial(PeriodicMLP, width=8, depth=1))
    return certify_fields(PROBLEM, trained, resolve_constants(PROBLEM), CHEAP, Run("manufactured", "toy"))


def row(found, words: str) -> str:
    return next(line for line in table(found.to_dict()).splitlines() if words in line)


@pytest.mark.nightly
def test_a_lower_bound_that_is_listed_is_shown_saved_and_used(listed):
    plain = certificate()
    listed(Toy(LOWER, 0.9999))
    found = certificate()
    assert "toy" not in plain.lower
    assert list(found.lower) == [*plain.lower, "toy"]
    said = json.loads(json.dumps(found.to_dict()))
    assert said["lower"]["toy"]["value"] == 0.9999 * OPT
    assert said["lower"]["toy"]["rests_on"] == {"toy": "given"}
    assert said["lower"]["toy"]["counts"]
    assert said["gap"]["lower_from"] == "toy"
    assert said["gap"]["simulated"] < plain.gap["simulated"]
    assert found.suboptimality["takes"] == ["the toy is right, as given"]
    assert row(found, "lower: a toy").split()[3] == f"{0.9999 * OPT:.8f}"
    assert found.hold
    for key, value in plain.to_dict().items():
        if key not in ("lower", "gap", "share", "suboptimality"):
            assert said[key] == json.loads(json.dumps(value))


def test_an_upper_bound_that_is_listed_is_shown_saved_and_used(listed):
    listed(Toy(UPPER, 1.001))
    found = certificate()
    assert (found.gap["upper_from"], found.best_upper) == ("toy", ("toy", 1.001 * OPT))
    assert found.gap["certified"] == pytest.approx(1.001 * OPT / found.best_lower[1] - 1.0)
    assert list(found.to_dict()["upper"]) == ["J", "G", "lagrangian", "toy"]
    assert "upper: a toy" in table(found.to_dict())


def test_what_its_need_says_decides_whether_it_counts(listed):
    listed(Toy(LOWER, 0.9999, holds=False))
    found = certificate()
    assert not found.to_dict()["lower"]["toy"]["counts"]
    assert found.gap["lower_from"] != "toy"
    assert found.supposed_gap == pytest.approx(found.best_perf[1] / (0.9999 * OPT) - 1.0)
    assert found.supposed_gap < found.gap["simulated"]
    assert not found.hold
    assert "not used" in row(found, "a toy")


@pytest.mark.nightly
@pytest.mark.parametrize("part", [0.9999, 2.0])
def test_one_that_rests_on_a_guess_is_conditional_until_another_refutes_it(listed, part):
    listed(Toy(LOWER, part, basis=GUESSED))
    found = certificate()
    said = found.to_dict()["lower"]["toy"]
    assert not said["counts"]
    assert found.gap["lower_from"] != "toy"
    assert found.contradiction is None
    assert found.hold
    assert (said.get("if") == "the toy is right") == (part < 1.0)
    assert (found.gap["conditional"] is not None) == (part < 1.0)
    assert (found.supposed_gap is not None) == (part < 1.0)
    assert any("it is not so that the toy is right" in w for w in found.warnings) == (part > 1.0)


@pytest.mark.nightly
def test_one_that_is_wrong_contradicts_the_others_and_is_named(listed):
    listed(Toy(LOWER, 2.0))
    found = certificate()
    assert "toy" in found.contradiction
    assert "the toy is right" in found.contradiction
    assert found.best_lower is None
    assert not found.hold


@pytest.mark.nightly
def test_a_given_controller_has_it_too_and_one_on_its_performance_from_below(listed):
    listed(Toy(LOWER, 0.9999))
    listed(Toy(PERFORMANCE, 0.5, name="toy below"))
    settings = {"value": Rough(), "settings": CHEAP, "train_steps": 0}
    found = certify(PROBLEM, lambda x: 0.0 * x, **settings)
    assert found.gap["lower_from"] == "toy"
    assert list(found.to_dict()["perf_lower"]) == ["evaluation", "lagrangian", "toy below"]
    assert "Perf, at least: toy below" in table(found.to_dict())


def test_the_benchmark_has_a_column_for_it_and_its_gap_uses_it(listed):
    listed(Toy(UPPER, 1.001))
    numbers = Judge(PROBLEM, resolve_constants(PROBLEM))(Fields({"value": Rough()}), None, perf=False)
    assert numbers["toy"] == 1.001 * OPT
    point = Point(1, 0.0, {**numbers, "J": 3.0 * OPT})
    assert point.gap == pytest.approx(1.001 * OPT / max(numbers["F_M"], numbers["shifted"]) - 1.0)
    head = next(line for line in contest_table([Curve("a", 0, [point])], OPT).splitlines() if "contender |" in line)
    assert [name for name in ("F_M", "shifted", "J", "toy") if f"| {name} |" in head] == ["F_M", "shifted", "J", "toy"]


def test_names_are_the_keys_of_the_schema_and_each_says_what_it_rests_on():
    assert list(bounds.on(LOWER)) == ["F_M", "shifted", "rigorous"]
    assert list(bounds.on(UPPER)) == ["J", "G", "lagrangian", "evaluation"]
    assert list(bounds.on(PERFORMANCE)) == ["evaluation", "lagrangian"]
    made = certificate()
    needs = {name: [n.name for n in made.needs(name)] for side in (LOWER, UPPER) for name in bounds.on(side)}
    assert needs == {
        "F_M": ["M"],
        "shifted": ["sup Q"],
        "rigorous": [],
        "J": ["C_V", "f", "regular"],
        "G": ["C_V", "f"],
        "lagrangian": ["sup |Q_u|", "regular"],
        "evaluation": ["sup |Q_u|"],
    }


def test_a_certificate_of_the_first_schema_is_still_shown():
    """Written before bounds said what they rest on: no level, no standing, no conditional gap, no sentence."""
    estimate = lambda value: {"value": value, "se": 1e-3}
    old = {
        "schema": 1,
        "problem": "circle",
        "method": "pd",
        "seed": 0,
        "exact": None,
        "lower": {"F_M": estimate(0.06), "shifted": None},
        "upper": {"J": estimate(0.07), "G": None, "lagrangian": estimate(0.062)},
        "perf": {"value": {**estimate(0.061), "bias": 1e-5}, "density": None},
        "baseline": {"zero": None},
        "gap": {"certified": 0.02, "simulated": 0.01},
        "share": {"certified": None, "simulated": None},
        "warnings": ["C_V is not known."],
    }
    shown = [line.split("  ")[0] for line in table(old).splitlines()[4:]]
    assert shown[:4] == ["lower: F_M", "Perf: controller from V", "upper: Lagrangian", "upper: J"]
    assert shown[5:] == ["gap, certified: 2.0000%", "gap, simulated: 1.0000%", "warning: C_V is not known."]


@pytest.mark.parametrize("unit", [1e-9, 1e-4, 1.0, 1e4, 1e9])
def test_the_table_tells_bounds_apart_in_any_unit_of_cost(unit):
    said = certificate().to_dict()
    for side in ("lower", "perf", "upper"):
        for estimate in filter(None, said[side].values()):
            estimate |= {"value": unit * estimate["value"], "interval": [unit * end for end in estimate["interval"]]}
    said["exact"] = unit * said["exact"]
    shown = [
        line[26:40] for line in table(said).splitlines() if line.startswith(("lower: F_M", "OPT", "Perf: controller"))
    ]
    true = [said["lower"]["F_M"]["value"], said["exact"], said["perf"]["value"]["value"]]
    assert [float(number) for number in shown] == pytest.approx(true, rel=1e-6)


def test_what_means_nothing_as_a_percentage_is_said_otherwise_and_a_warning_once():
    said = certificate().to_dict()
    said |= {
        "gap": {**said["gap"], "certified": 2.11, "simulated": 0.5},
        "share": {"certified": -4.74, "simulated": 0.9},
        "exact": 0.1,
        "warnings": ["twice.", "once.", "twice."],
        "suboptimality": {"at_least": None, "at_most": 0.5, "takes": []},
    }
    lines = table(said).splitlines()
    assert lines[1].startswith("the controller is at most 50 % worse than the optimum")
    assert "gap, certified: the upper side is 3.11 times the lower one" in lines
    assert "gap, simulated: 50.0000%, 90.00% of the gain over doing nothing" in lines
    assert [line for line in lines if "warning" in line] == ["warning: twice.", "warning: once."]
    assert not any("-474" in line or "211" in line for line in lines)
    said["exact"] = 1e-4  # everything is far above it
    far = [line for line in table(said).splitlines() if line.startswith(("lower", "upper", "Perf"))]
    assert far
    assert all(line.endswith(" times") for line in far)
