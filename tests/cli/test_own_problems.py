"""A problem of one's own on the command line: its own defaults, the command that names it again, and how it may fail late."""

import json
import math
import shlex
import sys

import pytest
import torch
import yaml

from ocp_torch import load_controller
from ocp_torch.cli.compose import composed, register_resolvers, with_own_defaults
from ocp_torch.errors import InputError
from ocp_torch.runs.build import build_problem, build_trainer
from ocp_torch.runs.compare import performance
from ocp_torch.training.monitor import Observer
from support import own_problems
from support.forked import TINY, command, completed, train

pytestmark = pytest.mark.usefixtures("cheap_looks")

register_resolvers()
SMALL = tuple(o for o in TINY if not o.startswith(("problem=", "trainer.evaluate_every")))


@pytest.fixture(scope="module")
def module(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    name = own_problems.write(folder)
    sys.path.insert(0, str(folder))
    yield folder, name
    sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def finished(module):
    """A run of `Pendula`, one of whose arguments was given."""
    folder, name = module
    run = folder / "run"
    mine = (f"problem._target_={name}.Pendula", "+problem.coupling=0.2")
    completed(*SMALL, *mine, "trainer.steps=4", "warm_start.mode=off", f"hydra.run.dir={run}", cwd=folder)
    return run


NEEDS = {
    "train": (),
    "reference": (),
    "certify": ("controller=x",),
    "record": ("out=x.npz",),
    "benchmark": (),
    "evaluate": ("run=x",),
    "rollout": ("run=x", "env=y"),
}


@pytest.mark.parametrize("script", NEEDS)
@pytest.mark.parametrize("mark", ["", *(pytest.param(m, marks=pytest.mark.nightly) for m in ("+", "++"))])
def test_in_every_script_it_starts_from_its_own_defaults(script, mark, module):
    target = f"{module[1]}.Pendula"
    for more, own in (((), {}), (("+problem.coupling=0.2", "problem.discount=2"), {"coupling": 0.2, "discount": 2})):
        section = composed(script, [*NEEDS[script], f"{mark}problem._target_={target}", *more])["problem"]
        assert section == {"_target_": target, **own}
    problem = build_problem(composed(script, [*NEEDS[script], f"{mark}problem._target_={target}"])["problem"])
    assert (problem.discount, problem.control_limit) == (3.5, 0.7)


@pytest.mark.parametrize("other", ["problem=torus", "experiment=gymnasium_pendulum", "experiment=torus"])
def test_no_other_choice_lends_it_fields(other, module):
    target = f"{module[1]}.Pendula"
    assert composed("train", [other, f"problem._target_={target}"])["problem"] == {"_target_": target}


def test_the_packages_own_classes_start_from_their_defaults_too():
    section = composed("train", ["problem._target_=ocp_torch.problems.Dubins"])["problem"]
    assert section == {"_target_": "ocp_torch.problems.Dubins"}


def test_what_names_no_class_is_left_as_it_was():
    for overrides in (["problem=torus", "problem.dim=3"], ["seed=1"], ["problem=callable", "problem.target=a:b"]):
        assert with_own_defaults("train", overrides) == overrides


def test_its_slips_are_named(module):
    with pytest.raises(InputError, match=r"problem.couplin is not a field of problem \(did you mean 'coupling'\?\)"):
        build_problem(composed("train", [f"problem._target_={module[1]}.Pendula", "problem.couplin=1"])["problem"])


@pytest.mark.nightly
def test_what_is_printed_and_stored_is_what_is_trained(finished, module):
    wanted = {"_target_": f"{module[1]}.Pendula", "coupling": 0.2}
    stored = yaml.safe_load((finished / ".hydra" / "config.yaml").read_text())
    assert stored["problem"] == wanted
    shown = command("train", *SMALL, f"problem._target_={module[1]}.Pendula", "--cfg", "job", cwd=module[0])
    assert shown.status == 0, shown
    assert yaml.safe_load(shown.stdout)["problem"] == {"_target_": f"{module[1]}.Pendula"}


def commands(script: str, run) -> list[str]:
    return {
        "evaluate": [f"run={run}", "certificate.points=32", "certificate.trajectories=2"],
        "reference": [f"run={run}", "side=32"],
        "rollout": [f"run={run}", "env=ocp_torch/Circle-v0"],
    }[script]


@pytest.mark.nightly
@pytest.mark.parametrize("script", ["evaluate", "reference", "rollout"])
def test_a_script_given_its_run_answers_with_the_command_to_copy(script, finished, module):
    typed = commands(script, finished)
    said = command(script, *typed, cwd=module[0]).sentence
    assert "belongs to the problem 'pendula', which is not part of ocp_torch" in said
    words = shlex.split(said.rpartition("if it is yours: ")[2])
    assert (words[0], words[1].rpartition("/")[2]) == ("python", f"{script}.py")
    assert words[2:] == [*typed, f"+problem._target_={module[1]}.Pendula", "+problem.coupling=0.2"]
    if script == "evaluate":
        assert command(script, *words[2:], cwd=module[0]).status == 0


@pytest.mark.parametrize("script", ["evaluate", "reference", "rollout"])
def test_a_script_refuses_other_arguments_than_those_of_the_run(script, finished, module):
    mine = f"+problem._target_={module[1]}.Pendula"
    for other in ((), ("+problem.coupling=0.25",), ("+problem.coupling=0.2", "+problem.discount=2")):
        said = command(script, *commands(script, finished), mine, *other, cwd=module[0]).sentence
        name, value, own = ("discount", 2.0, 3.5) if len(other) == 2 else ("coupling", 0.25 if other else 0.3, 0.2)
        assert f"problem.{name} is {value!r}" in said
        assert f"has {own!r}" in said


def test_a_controller_is_certified_for_its_own_problem_only(finished, module):
    typed = (f"controller={finished}", f"problem._target_={module[1]}.Pendula", "steps=2")
    assert "problem.coupling is 0.3" in command("certify", *typed, cwd=module[0]).sentence


def test_loading_says_how_and_refuses_other_arguments(finished, module):
    file = finished / "controller.safetensors"
    with pytest.raises(InputError, match=r"load_controller\(path, problem=Pendula\(coupling=0.2\)\)\."):
        load_controller(file)
    made = sys.modules.get(module[1]) or __import__(module[1])
    u = load_controller(file, problem=made.Pendula(0.2))
    assert u(torch.rand(3, 2)).shape == (3, 2)
    with pytest.raises(InputError, match=r"problem.coupling is 0.3, but the run of .* has 0.2"):
        load_controller(file, problem=made.Pendula())
    with pytest.raises(InputError, match=r"problem.control_limit is None, but .* has 0.7"):
        load_controller(file, problem=made.Pendula(0.2, control_limit=None))


@pytest.mark.nightly
def test_a_run_goes_on_with_the_arguments_it_has(finished, module):
    said = train(f"resume={finished}", "trainer.steps=6", cwd=module[0]).sentence
    words = shlex.split(said.rpartition("if it is yours: ")[2])
    assert words[2:] == [f"resume={finished}", "trainer.steps=6", f"problem._target_={module[1]}.Pendula"]
    said = train(*words[2:], "+problem.coupling=0.3", cwd=module[0]).sentence
    assert "problem.coupling is 0.3" in said
    assert "0.2" in said
    completed(*words[2:], cwd=module[0])
    assert json.loads((finished / "certificate.json").read_text())["step"] == 6


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("how", "calls", "words", "stopped"),
    [
        ("always", 4500, r"state_cost of own.*Ageing raised RuntimeError: licence expired ask your admin", "failed"),
        ("somewhere", 4500, "raised ValueError: no such state at x = [0.9", "failed"),
        (
            "holes",
            50,
            "where the state cost of the problem is not finite; it must be finite on the whole torus",
            "not_finite",
        ),
    ],
)
def test_a_problem_that_fails_late_leaves_a_sentence_and_the_best_look(how, calls, words, stopped, module):
    folder, name = module
    run = folder / f"late_{how}"
    mine = (f"problem._target_={name}.Ageing", f"problem.how={how}", f"problem.calls={calls}", f"hydra.run.dir={run}")
    ended = train(*SMALL, *mine, "trainer.steps=400", "trainer.evaluate_every=20", cwd=folder)
    assert ended.status == 2
    for word in words.split("own.*"):
        assert word in ended.sentence
    assert "Training stopped at step" in ended.sentence
    certificate = json.loads((run / "certificate.json").read_text())
    assert certificate["stopped"] == stopped
    assert certificate["step"] % 20 == 0 < certificate["step"]
    assert any("Training stopped" in w for w in certificate["warnings"])
    assert (run / "controller.safetensors").exists()


def test_a_problem_that_fails_in_another_script_ends_in_one_sentence(module):
    folder, name = module
    mine = (f"problem._target_={name}.Ageing", "problem.how=always")
    for script, more in (("record", ("out=x.npz", "samples=100000")), ("reference", ("side=128",))):
        said = command(script, *mine, "problem.calls=75", *more, cwd=folder).sentence
        assert "raised RuntimeError: licence expired" in said
    assert not (folder / "x.npz").exists()


@pytest.mark.parametrize("method", ["dual", "pd"])
def test_training_is_the_same_in_other_units(method, module):
    """Powers of two, by which floating-point numbers are scaled without an error."""

    def weights(k: int) -> dict:
        own = (f"problem._target_={module[1]}.Wide", f"problem.k={k}", f"method={method}", "trainer.steps=12")
        trainer = build_trainer(composed("train", [*SMALL, *own]))
        trainer.fit(Observer())
        return dict(trainer.averaged_fields.named_parameters())

    plain, wide = weights(0), weights(20)
    for name, tensor in plain.items():
        torch.testing.assert_close(wide[name], tensor, rtol=1e-3, atol=1e-4)


def test_the_performance_in_a_comparison_is_that_of_the_certified_controller():
    estimate = lambda value, se=0.0, **more: {"value": value, "se": se, "bias": 0.0, **more}
    perf = {"value": estimate(1.0, 0.5), "density": estimate(1.2, 0.01)}
    upper = {"J": None, "lagrangian": estimate(1.3, controller="density")}
    assert performance({"perf": perf, "upper": upper}) == 1.2
    assert performance({"perf": perf, "upper": {"J": None}}) == 1.2  # the smaller value is the less certain one
    assert performance({"perf": {**perf, "given": estimate(3.0)}, "upper": {}}) == 3.0
    assert performance({"perf": {"value": None}, "upper": {}}) is None
    assert not math.isnan(performance({"perf": {"value": estimate(1.0)}, "upper": {"J": None}}))
