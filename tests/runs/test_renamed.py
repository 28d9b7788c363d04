"""Runs and controllers of the version in which `problem=callable` was the class `Callable` go on and load as they did."""

import json
import textwrap

import pytest
import torch
import yaml

from ocp_torch import InputError, Simulator, load_controller
from ocp_torch.cli.compose import composed, register_resolvers
from ocp_torch.files.storage import load_tensors, save_tensors
from ocp_torch.problems.commands import ForeignProblem, current_name, current_target
from ocp_torch.runs.resume import find_run
from ocp_torch.training.checkpoint import load_checkpoint, save_checkpoint
from support.forked import TINY, train

OLD, NEW = "ocp_torch.problems.Callable", "ocp_torch.problems.Simulator"
SWING = """
import numpy as np

def swing(x):
    return 1.0 - np.cos(2 * np.pi * x[:, 0]), None, np.ones((len(x), 1, 1))
"""


@pytest.mark.parametrize(
    ("target", "now"),
    [
        (OLD, NEW),
        ("ocp_torch.problems.callable.Callable", NEW),
        ("ocp_torch.problems.manufactured.Manufactured", "ocp_torch.problems.Manufactured"),
        ("ocp_torch.problems.Circle", "ocp_torch.problems.Circle"),
        ("ocp_torch.problems.nowhere.Mine", "ocp_torch.problems.nowhere.Mine"),
        ("mine.Callable", "mine.Callable"),
        ("ocp_torch.problemsx.Callable", "ocp_torch.problemsx.Callable"),
        (None, None),
        (3, 3),
    ],
)
def test_a_class_of_the_package_is_known_by_its_earlier_names(target, now):
    assert current_target(target) == now


def test_a_users_own_class_of_the_same_name_stays_what_it_is():
    assert current_name("callable", {"_target_": OLD}) == "simulator"
    assert current_name("callable", {"_target_": "mine.Callable"}) == "callable"
    assert current_name("circle", {"_target_": "ocp_torch.problems.Circle"}) == "circle"
    assert current_name("simulator", {"_target_": NEW}) == "simulator"


def aged(folder) -> None:
    """What a run in ``folder`` left, by the names of the version before."""
    file = folder / ".hydra" / "config.yaml"
    file.write_text(file.read_text().replace(NEW, OLD))
    assert OLD in file.read_text()
    for path in (folder / "checkpoints").glob("*.pt"):
        state = load_checkpoint(path)
        state["config"]["problem"]["_target_"], state["problem"] = OLD, "callable"
        save_checkpoint(path, state)
    path = folder / "controller.safetensors"
    tensors, metadata = load_tensors(path)
    metadata["problem"]["name"], metadata["config"]["problem"]["_target_"] = "callable", OLD
    metadata["certificate"]["problem"] = "callable"
    save_tensors(path, tensors, metadata)


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    """The folder of an old run, and its problem as the command line names it."""
    place = tmp_path_factory.mktemp("old")
    (place / "swings.py").write_text(textwrap.dedent(SWING))
    simulated = ("problem=callable", f"problem.target={place}/swings.py:swing", "problem.dim=1")
    ended = train(*TINY, *simulated, "trainer.steps=4", f"hydra.run.dir={place}/run", cwd=place)
    assert ended.status == 0, ended
    aged(place / "run")
    return place / "run", simulated


@pytest.mark.nightly
def test_an_old_run_on_a_simulator_is_found_and_goes_on(old, tmp_path):
    folder, simulated = old
    register_resolvers()
    config = composed("train", [*TINY, *simulated, "trainer.steps=4"])
    assert find_run(config, (folder.parent,)) == folder
    with pytest.raises(ForeignProblem, match=NEW) as refused:
        composed("train", [f"resume={folder}"])
    assert f"problem._target_={NEW}" in refused.value.arguments
    ended = train(f"resume={folder}", *simulated, "trainer.steps=6", cwd=tmp_path)
    assert ended.status == 0, ended
    assert "going on from step 4" in ended.stdout
    assert json.loads((folder / "certificate.json").read_text())["step"] == 6
    kept = yaml.safe_load((folder / ".hydra" / "resume_1" / "config.yaml").read_text())
    assert kept["problem"]["_target_"] == NEW


def test_an_old_controller_loads_and_says_which_problem_it_lacks(old, tmp_path):
    folder, simulated = old
    path = folder / "controller.safetensors"
    tensors, metadata = load_tensors(path)
    metadata["problem"]["name"], metadata["config"]["problem"]["_target_"] = "callable", OLD
    save_tensors(tmp_path / "controller.safetensors", tensors, metadata)
    with pytest.raises(InputError, match="problem=Simulator"):
        load_controller(tmp_path / "controller.safetensors")
    u = load_controller(tmp_path / "controller.safetensors", problem=Simulator(simulated[1].split("=")[1], dim=1))
    assert u(torch.rand(3, 1)).shape == (3, 1)


def test_the_name_that_an_old_version_told_to_type_still_works(old):
    _, simulated = old
    named = composed("train", [f"problem._target_={OLD}", *simulated[1:], "method=dual"])
    from ocp_torch.runs.build import build_problem

    assert type(build_problem(named["problem"])) is Simulator
