"""The two scripts as a user meets them: from any folder, with mistakes, with a problem of his own, and as a sweep."""

import os
import shutil
import subprocess
import sys
import threading
import uuid
from pathlib import Path

import pytest

from ocp_torch import load_controller
from ocp_torch.certificate import table
from ocp_torch.cli.explain import CHECKOUT
from ocp_torch.cli.launch import unless_told
from support.forked import assert_succeeded, certificate_in, script

# Enough for a run of its own folder and certificate, and no more.
SHORT = (
    "experiment=debug",
    "method=dual",
    "trainer.steps=3",
    "trainer.evaluate_every=0",
    "trainer.figures=false",
    "certificate.points=32",
    "certificate.tolerance=0.01",
    "certificate.occupation_states=0",
    "certificate.trajectories=0",
    "certificate.stage.steps=0",
)
OWN_MODULE = """
import torch
from ocp_torch import Problem

class Flat{mark}(Problem):
    def __init__(self):
        super().__init__(dim=1)

    def state_cost(self, x):
        return torch.full_like(x[:, 0], 0.5)

class Level{mark}(Problem):
    def __init__(self, k, discount=2.0):
        super().__init__(dim=2, discount=discount)
        self.k = k

    def state_cost(self, x):
        return torch.full_like(x[:, 0], float(self.k))
"""


def fresh(name: str, *arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    """The script as a shell starts it, imports and all."""
    words = [sys.executable, str(CHECKOUT / "scripts" / f"{name}.py"), *arguments]
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(words, cwd=cwd, env=one_thread, capture_output=True, text=True, timeout=300)


def assert_prints(certificate: dict, printed: str) -> None:
    """Every row of the table of ``certificate`` was printed, number for number."""
    missing = set(table(certificate).splitlines()) - set(printed.splitlines())
    assert not missing, printed


def assert_refused(result: subprocess.CompletedProcess) -> str:
    """One line of explanation, no traceback, and a status that scripts can see."""
    assert result.returncode != 0
    assert "Traceback" not in result.stderr + result.stdout
    (line,) = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    return line


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a finished run, started from a folder that is not the checkout, and what the run printed."""
    cwd, folder = tmp_path_factory.mktemp("elsewhere"), tmp_path_factory.mktemp("runs") / "debug"
    result = fresh("train", "experiment=debug", f"hydra.run.dir={folder}", cwd=cwd)
    assert_succeeded(result)
    assert list(cwd.iterdir()) == []
    return folder, result.stdout


@pytest.mark.nightly
def test_a_debug_run_prints_its_certificate_and_leaves_its_files(finished):
    folder, printed = finished
    assert_prints(certificate_in(folder), printed)
    names = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    documented = {
        "train.log",
        "checkpoints/last.pt",
        "checkpoints/best.pt",
        "controller.safetensors",
        "certificate.json",
        "report.html",
    }
    assert documented <= names
    others = names - documented
    assert {name.split("/")[0].split(".tfevents")[0] for name in others} == {".hydra", "figures", "events.out"}
    assert "circle / pd, seed 0" in (folder / "train.log").read_text()
    assert load_controller(folder / "controller.safetensors").problem.dim == 1


@pytest.mark.nightly
def test_evaluate_reproduces_the_numbers_of_the_certificate(finished, tmp_path):
    folder, _ = finished
    before = sorted(folder.rglob("*"))
    result = script("evaluate", f"run={folder}", cwd=tmp_path)
    assert_succeeded(result)
    assert_prints(certificate_in(folder), result.stdout)
    assert sorted(folder.rglob("*")) == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_evaluate_on_another_seed_takes_other_states(finished, tmp_path):
    file = finished[0] / "controller.safetensors"
    cheap = ("certificate.trajectories=0", "certificate.stage.steps=0")
    result = script("evaluate", f"run={file}", "seed=7", *cheap, cwd=tmp_path)
    assert_succeeded(result)
    (row,) = [line for line in result.stdout.splitlines() if line.startswith("lower: F_M")]
    own = certificate_in(finished[0])["lower"]["F_M"]["value"]
    other = float(row.split()[2])
    assert other != pytest.approx(own, abs=1e-8)
    assert other == pytest.approx(own, rel=1e-2)


MISTAKES = {
    "trainer.steps=abc": ("trainer.steps", "'abc'", "whole number"),
    "problem=manufactured problem.exponent=3": ("problem.exponent", "3", "at most 2"),
    "method=primal problem=manufactured method.occupation=closed": ("method.occupation", "closed", "drift"),
    "problem.discount=-1": ("problem.discount", "-1", "at least 1e-06"),
}


@pytest.mark.parametrize("overrides", MISTAKES)
def test_a_mistake_ends_in_one_line_before_any_folder_is_made(overrides, tmp_path):
    result = script("train", *overrides.split(), f"hydra.run.dir={tmp_path / 'run'}", cwd=tmp_path)
    line = assert_refused(result)
    assert all(word in line for word in MISTAKES[overrides]), line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arguments", [("run=missing",), ("run=.",), ()], ids=["missing", "no run", "none"])
def test_evaluate_without_a_run_ends_in_one_line_that_says_what_to_give(arguments, tmp_path):
    line = assert_refused(script("evaluate", *arguments, f"hydra.run.dir={tmp_path / 'new'}", cwd=tmp_path))
    assert "run" in line or "controller.safetensors" in line
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def own_module(tmp_path):
    """A folder with a user's module, and the mark in its classes' names by which their outputs can be told."""
    mark = uuid.uuid4().hex[:8]
    (tmp_path / "my_module.py").write_text(OWN_MODULE.format(mark=mark))
    yield tmp_path, mark
    for folder in (CHECKOUT / "outputs").glob(f"*{mark}*"):
        shutil.rmtree(folder)


@pytest.mark.nightly
def test_a_problem_of_your_own_is_found_where_you_are_and_its_run_lands_in_the_checkout(own_module):
    cwd, mark = own_module
    assert_succeeded(script("train", *SHORT, f"problem._target_=my_module.Flat{mark}", cwd=cwd))
    assert {p.name for p in cwd.iterdir()} <= {"my_module.py", "__pycache__"}
    (folder,) = (CHECKOUT / "outputs" / f"flat{mark}_dual").iterdir()
    assert certificate_in(folder)["problem"] == f"flat{mark}"


@pytest.mark.nightly
def test_a_problem_of_your_own_takes_arguments_in_training_and_in_evaluation(own_module):
    cwd, mark = own_module
    mine = (f"problem._target_=my_module.Level{mark}", "+problem.k=2", "problem.discount=3")
    folder = cwd / "run"
    result = script("train", *SHORT, *mine, f"hydra.run.dir={folder}", cwd=cwd)
    assert_succeeded(result)
    assert "d = 2, m = 2, rho = 3" in result.stdout
    line = assert_refused(script("evaluate", f"run={folder}", cwd=cwd))
    assert "problem" in line
    again = [f"+{argument.lstrip('+')}" for argument in mine]
    result = script("evaluate", f"run={folder}", *again, cwd=cwd)
    assert_succeeded(result)
    assert_prints(certificate_in(folder), result.stdout)


@pytest.mark.parametrize(
    ("extra", "word"), [("+problem.kk=2", "problem.kk"), ("problem.discount=2", "problem.k is missing")]
)
def test_a_problem_of_your_own_names_the_argument_that_is_wrong_or_missing(own_module, extra, word):
    cwd, mark = own_module
    arguments = (f"problem._target_=my_module.Level{mark}", extra, f"hydra.run.dir={cwd / 'run'}")
    assert word in assert_refused(script("train", *arguments, cwd=cwd))
    assert not (cwd / "run").exists()


@pytest.mark.nightly
def test_a_sweep_gives_each_run_a_folder_named_after_problem_method_and_seed(tmp_path):
    sweep = tmp_path / "sweep"
    assert_succeeded(script("train", "-m", *SHORT, "seed=0,1", f"hydra.sweep.dir={sweep}", cwd=tmp_path))
    folders = sorted(p for p in sweep.iterdir() if p.is_dir())
    assert [p.name for p in folders] == ["0_circle_dual_seed0", "1_circle_dual_seed1"]
    first, second = map(certificate_in, folders)
    assert (first["seed"], second["seed"]) == (0, 1)
    assert first["lower"] != second["lower"]
    assert [p.name for p in tmp_path.iterdir()] == ["sweep"]


@pytest.mark.nightly
def test_a_wrong_job_of_a_sweep_ends_alone_and_is_named_at_the_end(tmp_path):
    arguments = (*SHORT, "problem.discount=-1,2", f"hydra.sweep.dir={tmp_path / 'sweep'}")
    result = script("train", "-m", *arguments, cwd=tmp_path)
    assert result.returncode != 0
    assert "Traceback" not in result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert "problem.discount is -1" in errors[0]
    assert "1 job(s)" in errors[-1]
    assert certificate_in(tmp_path / "sweep" / "1_circle_dual_seed0")["method"] == "dual"


def test_what_ends_tensorboards_thread_is_left_to_who_writes_next_and_every_other_thread_is_told(capsys):
    from tensorboard.summary.writer.event_file_writer import _AsyncWriterThread

    full = OSError(28, "No space left on device")
    for thread, told in ((_AsyncWriterThread(None, None, 1), False), (threading.Thread(), True)):
        unless_told(threading.ExceptHookArgs((OSError, full, None, thread)))
        assert ("No space left" in capsys.readouterr().err) == told
