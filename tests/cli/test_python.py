"""`train`, `reference` and `compare` from Python: the script's to the bit, its sentences, and a process left as it was."""

import json
import logging
import random
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.singleton import Singleton
from omegaconf import OmegaConf

from ocp_torch import Circle, Problem, compare, load_controller, reference, train
from ocp_torch.cli.explain import CONFIGS
from ocp_torch.cli.python import TrainedRun, TrainingFailed
from ocp_torch.errors import InputError
from ocp_torch.runs.compare import compare as compared
from ocp_torch.training.checkpoint import load_checkpoint
from support.bits import differences
from support.forked import TINY, certificate_in, finished_run
from support.run_folders import assert_same_run
from support.small import outcome

pytestmark = pytest.mark.usefixtures("cheap_looks")
SETTINGS = {name: yaml.safe_load(value) for name, value in (o.split("=") for o in TINY[1:])}
SHORT = SETTINGS | {"trainer.steps": 10}


class Hill(Problem):
    """Of a user's own, with an argument that no file can hold."""

    def __init__(self, height: float = 0.5, shape=torch.cos) -> None:
        super().__init__(dim=1)
        self.height, self.shape, self.hot = height, shape, False
        self.occupation_bound = 9.0  # without one a V is trained for its bound

    def state_cost(self, x):
        if self.hot:
            raise RuntimeError("the motor is hot")
        return self.height * (1.0 + self.shape(2.0 * torch.pi * x[:, 0]))


def weights(run) -> dict:
    return dict(run.controller.fields.state_dict())


def timeless(certificate: dict) -> dict:
    return certificate | {"train_seconds": None}


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """The folder of a run of scripts/train.py."""
    return finished_run(tmp_path_factory.mktemp("script") / "run", *TINY, "seed=4")


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """The same from Python, and in a folder."""
    return train("circle", seed=4, folder=tmp_path_factory.mktemp("here") / "run", settings=SETTINGS)


def test_a_run_is_that_of_the_script_to_the_bit(here, script):
    assert_same_run(here.folder, script)
    assert timeless(here.certificate) == timeless(certificate_in(script))
    scripted = load_controller(script / "controller.safetensors").fields.state_dict()
    assert differences(weights(here), dict(scripted)) == []


@pytest.mark.nightly
def test_without_a_folder_and_of_an_object_it_is_the_same_again(here):
    for _ in range(2):
        again = train(Circle(), seed=4, settings=SETTINGS, callback=lambda moment: torch.rand(3).sort())
        assert differences(weights(again), weights(here)) == []
        assert timeless(again.certificate) == timeless(here.certificate)
        assert again.folder is None


def process() -> dict:
    """What a library must leave alone."""
    return {
        "torch": torch.get_rng_state().tolist(),
        "numpy": str(np.random.get_state()),  # noqa: NPY002
        "python": random.getstate(),
        "threads": (torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()),
        "path": list(sys.path),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)],
        "logging": [(logger.level, list(logger.handlers)) for logger in map(logging.getLogger, ("", "ocp_torch"))],
        "resolvers": OmegaConf.has_resolver("checkout"),
        "hydra": {c.__name__: id(made) for c, made in Singleton._instances.items()},
    }


def test_the_process_is_left_as_it_was_within_an_application_of_hydra_too():
    with initialize_config_dir(str(CONFIGS), version_base="1.2"):
        before, mine = process(), GlobalHydra.instance().hydra
        train("circle", settings=SHORT)
        with pytest.raises(InputError):
            train("circel")
        assert process() == before
        assert GlobalHydra.instance().hydra is mine


@pytest.mark.parametrize("without", [torch.no_grad, torch.inference_mode])
def test_a_caller_may_have_switched_gradients_off(without):
    with without():
        run = train("circle", settings=SHORT)
        assert not torch.is_grad_enabled()
    assert run.certificate["step"] == 10


@pytest.mark.nightly
def test_a_callback_hears_of_steps_and_looks_as_the_history_keeps_them():
    heard = []
    looking = SHORT | {"trainer.evaluate_every": 5}
    run = train("circle", settings=looking, callback=heard.append)
    assert [(m.kind, m.step) for m in heard] == [("step", 5), ("look", 5), ("step", 10)]
    assert [row["step"] for row in run.history.steps] == [5, 10]
    assert [row["step"] for row in run.history.looks] == [5, 10]
    assert heard[1].certificate["lower"]["F_M"]["value"] == run.history.looks[0]["bounds/F_M"]
    assert run.history.looks[-1]["bounds/F_M"] == run.certificate["lower"]["F_M"]["value"]
    assert np.isfinite(run.history.steps[0]["loss/value"])


@pytest.mark.nightly
def test_a_callback_stops_the_run_which_is_certified_and_goes_on_to_the_same_bits(here, tmp_path):
    stopped = train("circle", seed=4, folder=tmp_path / "run", settings=SETTINGS, callback=lambda m: m.step >= 15)
    assert (stopped.certificate["step"], stopped.certificate["stopped"]) == (15, "callback")
    assert stopped.certificate["lower"]["F_M"] is not None
    whole = train("circle", resume=tmp_path / "run")
    assert differences(weights(whole), weights(here)) == []
    assert timeless(whole.certificate) == timeless(here.certificate)
    again = train("circle", resume=tmp_path / "run")  # nothing is left to do
    assert (again.certificate, again.history.steps) == (whole.certificate, [])


def test_a_keyword_that_nobody_has_is_said_to_have_gone_to_the_problem():
    with pytest.raises(InputError, match=r"problem.stepz is not a field .*keywords that the call itself has not go to"):
        train("circle", stepz=3)


def test_a_callback_is_a_function():
    with pytest.raises(InputError, match="callback is 3, but must be a function of one Moment, or None"):
        train("circle", callback=3)


def test_what_a_callback_raises_is_raised():
    with pytest.raises(ZeroDivisionError):
        train("circle", settings=SHORT, callback=lambda moment: 1 / 0)


ENDLESS, ENDLESS_GROUP = [1.0], {}
ENDLESS.append(ENDLESS)
ENDLESS_GROUP["trainer"] = ENDLESS_GROUP


@pytest.mark.parametrize(
    ("asked", "override"),
    [
        (lambda: train("circel"), "problem=circel"),
        (lambda: train("circle", nose=1.0), "problem.nose=1.0"),
        (lambda: train("circle", discount=-1), "problem.discount=-1"),
        (lambda: train("circle", steps="many"), "trainer.steps=many"),
        (lambda: train("circle", settings={"trainer.stepz": 3}), "trainer.stepz=3"),
        (lambda: train("circle", settings={"trainer": {"batch": 0}}), "trainer.batch=0"),
        (lambda: train("circle", resume="nowhere"), "resume=nowhere"),
        (lambda: train("circle", resume=""), "resume="),
    ],
)
def test_a_mistake_is_told_as_on_the_command_line(asked, override):
    told = outcome(override)
    with pytest.raises(InputError) as error:
        asked()
    said, hint, _ = told.partition("; write +")  # the hint how to add a field is for the command line alone
    assert str(error.value) == told or (hint and str(error.value).startswith(f"{said}; keywords that"))


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (lambda: train(3), ("problem is 3", "Problem")),
        (lambda: train(Circle(), noise=1.0), ("problem.noise", "object")),
        (lambda: train("circle", steps=1, settings={"trainer.steps": 2}), ("trainer.steps is set twice",)),
        (lambda: train("circle", settings={"trainer.batch": object()}), ("trainer.batch", "number")),
        (lambda: train("circle", settings={"hydra.run.dir": "x"}), ("hydra.run.dir", "folder")),
        (lambda: train("circle", settings={"a b": 1}), ("'a b'", "trainer.batch")),
        (lambda: train("circle", folder="/dev/null/x"), ("folder", "/dev/null/x")),
        (lambda: reference("circle", side=-3), ("side",)),
        (lambda: compare(["nowhere"]), ("nowhere",)),
        (lambda: compare(None), ("a run is None", "path")),
        (lambda: compare([3]), ("a run is 3", "path")),
        (lambda: train("circle", folder=3), ("folder is 3", "path")),
        (lambda: load_controller(None), ("path is None", "outputs/circle_pd")),
        (lambda: train("circle", noise=ENDLESS), ("problem.noise", "holds itself")),
        (lambda: train("circle", settings=ENDLESS_GROUP), ("settings", "holds itself")),
    ],
)
def test_a_mistake_that_only_python_can_make_is_told_in_a_sentence(asked, words):
    with pytest.raises(InputError) as error:
        asked()
    assert all(word in str(error.value) for word in words), error.value


def test_a_folder_that_holds_a_run_is_not_written_to(here):
    with pytest.raises(InputError, match="holds a run already"):
        train("circle", folder=here.folder, settings=SETTINGS)


@pytest.mark.nightly
def test_a_problem_of_ones_own_is_trained_as_it_is_and_its_controller_is_loaded_with_it(tmp_path):
    run = train(Hill(0.3), folder=tmp_path / "run", settings=SHORT)
    assert run.controller.config["problem"]["height"] == 0.3
    loaded = load_controller(tmp_path / "run" / "controller.safetensors", problem=Hill(0.3))
    x = torch.rand(9, 1)
    assert torch.equal(loaded(x), run.controller(x))
    assert train(Hill(0.3), resume=tmp_path / "run").certificate == run.certificate


def test_a_report_is_written_anew_where_the_run_is_in_a_folder(here):
    written = here.report()
    assert written == here.folder / "report.html"
    assert "<h1>circle</h1>" in written.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="folder=") as refused:
        replace(here, folder=None).report()
    assert "\n" not in str(refused.value)


def test_a_run_that_fails_under_way_still_gives_what_it_has():
    hill = Hill()
    heats = lambda moment: setattr(hill, "hot", moment.kind == "look")
    with pytest.raises(TrainingFailed, match="the motor is hot") as error:
        train(hill, settings=SHORT | {"trainer.evaluate_every": 5}, callback=heats)
    assert error.value.run.certificate["stopped"] == "failed"


def test_a_run_whose_problem_fails_for_good_claims_nothing_by_a_quick_evaluation():
    """No walls are looked for in its paths, and no peaks in steep places: a bound of a hidden peak was 5 % too high."""
    hill = Hill()
    heats = lambda moment: setattr(hill, "hot", moment.kind == "look")
    with pytest.raises(TrainingFailed) as error:
        train(hill, settings=SHORT | {"trainer.evaluate_every": 5}, callback=heats)
    made = error.value.run.certificate
    assert any("quick evaluation at step 5" in warning for warning in made["warnings"])
    assert made["perf"]["value"] is not None
    assert made["lower"]["shifted"] is not None
    assert not any(bound["counts"] for bound in made["lower"].values() if bound is not None)
    assert [made["gap"][kind] for kind in ("certified", "simulated", "conditional")] == [None] * 3
    assert made["suboptimality"]["at_most"] is None
    assert made["suboptimality"]["at_least"] is None
    assert not made["assumptions"]["hold"]


def test_runs_in_memory_stand_beside_runs_in_folders(here, script):
    table = compare([TrainedRun(here.controller, here.certificate), here, script])
    assert {row["run"] for row in table.rows} == {"run 0", str(here.folder), "run"}
    (mine,) = [row for row in table.rows if row["run"] == str(here.folder)]
    (theirs,) = compared([script]).rows
    own = {"run": None, "train_seconds": None}
    assert mine | own == theirs | own
    assert "run 0" in str(table)


def test_the_reference_of_a_name_and_of_an_object_is_the_same():
    by_name, by_object = reference("circle", side=32, discount=3.0), reference(Circle(discount=3.0), side=32)
    assert by_name.optimum == by_object.optimum
    assert by_name.optimum == pytest.approx(Circle(discount=3.0).exact_optimum, abs=1e-3)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_lets_the_step_finish_saves_and_then_does_what_it_did_before(number, tmp_path):
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: heard.append(number))
    send = lambda moment: signal.raise_signal(number)
    try:
        with pytest.raises(KeyboardInterrupt):
            train("circle", seed=4, folder=tmp_path / "run", settings=SETTINGS, callback=send)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert heard == [signal.SIGTERM] * (number == signal.SIGTERM)
    state = load_checkpoint(tmp_path / "run" / "checkpoints" / "last.pt")
    assert state["step"] == SETTINGS["trainer.log_every"]


def test_an_impatient_second_ctrl_c_ends_the_run_and_not_the_process():
    def twice(moment):
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("it went on")

    with pytest.raises(KeyboardInterrupt):
        train("circle", settings=SHORT, callback=twice)


@pytest.mark.nightly
def test_a_noisy_system_trained_by_pd_with_looks_and_figures_is_the_scripts_to_the_bit(tmp_path):
    given = {"experiment": "debug", "problem.torque_noise": 0.3, "method.occupation_bound": 30, "trainer.steps": 20}
    given |= {"trainer.evaluate_every": 10, "trainer.log_every": 5, "certificate.occupation_states": 0}
    whole = finished_run(tmp_path / "whole", "problem=pendulum", *(f"{k}={v}" for k, v in given.items()))
    run = train("pendulum", folder=tmp_path / "run", settings=given)
    assert_same_run(run.folder, whole)
    assert run.metrics == json.loads((whole / "metrics.json").read_text())
    assert compare(tmp_path).rows[0]["problem"] == "pendulum"


@pytest.mark.nightly
def test_importing_the_package_imports_neither_the_command_line_nor_what_draws(tmp_path):
    asked = "import sys, ocp_torch; print([m for m in sys.modules if m in ('hydra', 'matplotlib', 'tensorboard')])"
    done = subprocess.run([sys.executable, "-c", asked], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "[]\n"
