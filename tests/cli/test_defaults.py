"""A default stands in one place: what `--help` shows is what a caller in Python gets, or Python has no default of its own."""

import inspect
from collections.abc import Callable

import pytest
import yaml

from ocp_torch import certify
from ocp_torch.certificate import CertificateSettings, StageSettings
from ocp_torch.cli.compose import composed, register_resolvers
from ocp_torch.cli.explain import CONFIGS
from ocp_torch.fields import MODELS
from ocp_torch.files.plain import value_at
from ocp_torch.maths.sampling import SAMPLERS
from ocp_torch.objectives import METHODS
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.runs.build import BOUND_FIELDS, build_problem, problem_class
from ocp_torch.steppers import STEPPERS, averaged, schedule_maker
from ocp_torch.steppers.fitting import OPTIMIZERS
from ocp_torch.studies.benchmark.contenders import KernelContender
from ocp_torch.studies.reference.reference import solve_reference
from ocp_torch.training.batches import Batches
from ocp_torch.training.budgets import fill
from ocp_torch.training.settings import TrainerSettings
from ocp_torch.training.warm_start.settings import WarmStartSettings
from support.small import outcome

register_resolvers()
CHOICES = sorted(
    f"{p.parent.name}/{p.stem}" for p in CONFIGS.glob("*/*.yaml") if p.parent.name != "experiment"
)  # experiments are what somebody set, not defaults
# Who takes the fields of a section, by the name of its group.
TAKERS: dict[str, Callable[[dict], list[Callable]]] = {
    "problem": lambda section: [problem_class(section["_target_"])],
    "method": lambda section: [METHODS[section["name"]], resolve_constants],
    "model": lambda section: [MODELS[section["name"]]],
    "optimizer": lambda section: [OPTIMIZERS[section["name"]]],
    "schedule": lambda section: [schedule_maker],
    "stepper": lambda section: [STEPPERS[section["name"]]],
    "averaging": lambda section: [averaged],
    "sampler": lambda section: [Batches, *SAMPLERS.values()],
    "trainer": lambda section: [TrainerSettings],
    "warm_start": lambda section: [WarmStartSettings],
    "certificate": lambda section: [CertificateSettings],
}
# Fields that choose the taker, or are made of others.
CHOOSE = ("_target_", "name", "kind", "player_lr", "stage")
# Parameters that a run fills in from other places than the section.
FILLED = {
    "dataset": ("dim", "control_dim", "constant_matrix"),  # of the file
    "method": ("problem", "constants"),
    "model": ("dim", "outputs", "shift", "scale", "centred"),
    "optimizer": ("parameters",),
    "schedule": ("name", "steps"),
    "stepper": ("fields", "objective", "optimizers", "schedule", "unit"),
    "averaging": ("fields", "kind"),
    "certificate": ("stage",),
}


def section_of(choice: str) -> dict:
    return yaml.safe_load((CONFIGS / f"{choice}.yaml").read_text())


def parameters(*takers: Callable) -> dict[str, inspect.Parameter]:
    return {name: p for taker in takers for name, p in inspect.signature(taker).parameters.items()}


def plain(value: object) -> object:
    return [plain(one) for one in value] if isinstance(value, list | tuple) else value


def disagreements(section: dict, takers: list[Callable]) -> list[str]:
    """Fields that have another default in Python; a null is left to be chosen, and `???` to be given."""
    known, found = parameters(*takers), []
    for field, value in section.items():
        if field in CHOOSE or value is None or value == "???":
            continue
        default = known[field].default if field in known else "no parameter"
        if default is not inspect.Parameter.empty and plain(default) != value:
            found.append(f"{field}: {value!r} in YAML, {default!r} in Python")
    return found


@pytest.mark.parametrize("choice", CHOICES)
def test_a_default_in_yaml_is_that_of_python_or_the_only_one(choice):
    section = section_of(choice)
    assert disagreements(section, TAKERS[choice.split("/")[0]](section)) == []
    assert disagreements(section.get("stage") or {}, [StageSettings]) == []


@pytest.mark.parametrize("group", TAKERS)
def test_no_default_of_python_is_hidden_from_help(group):
    """Every parameter that may be left out has its line in a file of the group."""
    sections = {choice: section_of(choice) for choice in CHOICES if choice.startswith(f"{group}/")}
    for choice, section in sections.items():
        taker = TAKERS[group](section)[0]
        shared = (
            sections.values() if group in ("schedule", "averaging") else [section]
        )  # one function takes all choices
        shown = {field for one in shared for field in one}
        optional = {n for n, p in parameters(taker).items() if p.default is not inspect.Parameter.empty}
        filled = {*FILLED.get(group, ()), *FILLED.get(choice.split("/")[1], ())}
        assert optional - shown - filled == set()


def test_what_is_null_is_chosen_in_one_place_for_the_command_line_and_for_python():
    """By `fill` and the model, from the dimension; what stays null has that meaning in Python too."""
    config = composed("train", ["problem=torus", "problem.dim=3"])
    problem = build_problem(config["problem"])
    filled = fill(config, problem)
    bare = fill({"model": {"name": "mlp"}, "trainer": {}, "optimizer": {}, "certificate": {}}, problem)
    assert bare["model"] == filled["model"]
    for group, section in filled.items():
        if not isinstance(section, dict):
            continue
        known = parameters(*TAKERS[group](section))
        for field in (f for f, value in section.items() if value is None and f not in BOUND_FIELDS):
            assert known[field].default in (None, inspect.Parameter.empty), f"{group}.{field}"


@pytest.mark.parametrize("problem", ["circle", "unicycle", "pendulum", "cart_pole"])
def test_half_the_effort_is_half_of_all_steps_that_nobody_set(problem):
    """With noise too; and what is set stays as it is."""
    places = ("trainer.steps", "certificate.stage.steps", "certificate.bound_steps", "warm_start.rounds")
    for noise in (0.0, 1e-3):
        steps = {}
        for effort in (1.0, 0.5):
            named = [f"problem={problem}", f"problem.noise={noise}", f"trainer.effort={effort}"]
            config = composed("train", named)
            filled = fill(config, build_problem(config["problem"]))
            steps[effort] = [value_at(filled, place) for place in places]
        assert [2 * half for half in steps[0.5]] == steps[1.0]
        assert all(isinstance(half, int) for half in steps[0.5])
        set_ = composed("train", [*named, "trainer.steps=7", "certificate.bound_steps=9"])
        filled = fill(set_, build_problem(set_["problem"]))
        assert (filled["trainer"]["steps"], filled["certificate"]["bound_steps"]) == (7, 9)


@pytest.mark.parametrize(("effort", "starts"), [(4.0, 256), (1.0, 256), (0.5, 128), (0.3, 64), (0.01, 32)])
def test_less_effort_simulates_from_fewer_starts(effort, starts):
    config = composed("train", [f"trainer.effort={effort}"])
    problem = build_problem(config["problem"])
    assert fill(config, problem)["certificate"]["trajectories"] == starts
    config["certificate"]["trajectories"] = 100
    assert fill(config, problem)["certificate"]["trajectories"] == 100


@pytest.mark.parametrize("effort", ["0", "-1", "1e9", "nan", "much", "null"])
def test_an_effort_that_is_none_is_refused_by_name(effort):
    assert "trainer.effort" in outcome(f"trainer.effort={effort}")


def test_commands_beside_training_have_the_defaults_of_their_functions():
    benchmark, reference = (yaml.safe_load((CONFIGS / f"{n}.yaml").read_text()) for n in ("benchmark", "reference"))
    kernel = {field: value for field, value in benchmark["kernel"].items() if field != "step"}
    assert disagreements(kernel, [KernelContender]) == []
    assert reference["memory"] == parameters(solve_reference)["memory"].default
    certified = yaml.safe_load((CONFIGS / "certify.yaml").read_text())
    assert certified["seed"] == parameters(certify)["seed"].default
