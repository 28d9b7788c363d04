"""Going on without a configuration beside the checkpoint: the checkpoint's own is used, and nothing wrong is left behind."""

import errno
import os
import shutil
from pathlib import Path

import pytest
import yaml

from ocp_torch.cli import compose as composition
from ocp_torch.cli import single
from ocp_torch.errors import InputError
from ocp_torch.runs.configuration import read_configuration, saved_configuration
from ocp_torch.runs.run import training_run
from ocp_torch.training.checkpoint import load_checkpoint
from support.forked import TINY, completed, finished_run, train

# Everything but the defaults: what a command line of `resume` alone would compose is another run.
OTHER = ("problem=torus", "problem.dim=2", "problem.shear=none", "seed=3", *TINY[1:])


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return finished_run(tmp_path_factory.mktemp("bare") / "run", *OTHER)


@pytest.fixture
def run(trained, tmp_path):
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def left_behind(folder: Path) -> list[dict]:
    """Every configuration in ``folder`` and below, wherever a later reader might find it."""
    return [read_configuration(file) for file in folder.rglob("config.yaml")]


def own(folder: Path) -> dict:
    return load_checkpoint(folder / "checkpoints" / "last.pt")["config"]


def agrees(config: dict, made: dict) -> bool:
    """Whether ``config`` is that of the run ``made``, but for fields that are null in it."""
    if isinstance(config, dict):
        return all(agrees(v, made.get(k)) for k, v in config.items() if k not in ("resume", "steps"))
    return config is None or config == made


def test_a_folder_of_runs_is_refused_and_the_newest_is_named(tmp_path):
    for age, name in enumerate(("later", "earlier")):
        file = tmp_path / name / "checkpoints" / "last.pt"
        file.parent.mkdir(parents=True)
        file.touch()
        os.utime(file, (100 - age, 100 - age))
    with pytest.raises(InputError, match=f"holds 2 of them; the newest is resume={tmp_path / 'later'}\\.$"):
        saved_configuration(tmp_path)


@pytest.mark.nightly
@pytest.mark.parametrize("lost", [".hydra", ".hydra/config.yaml"])
def test_a_folder_without_configuration_goes_on_with_that_of_its_checkpoint(lost, run, tmp_path):
    shutil.rmtree(run / lost) if (run / lost).is_dir() else (run / lost).unlink()
    made = own(run)
    completed(f"resume={run}", "trainer.steps=70", cwd=tmp_path)
    assert own(run) == {**made, "trainer": {**made["trainer"], "steps": 70}}
    assert left_behind(run)
    assert all(agrees(config, made) for config in left_behind(run))
    completed(f"resume={run}", cwd=tmp_path)  # and again, from what that left
    assert own(run)["trainer"]["steps"] == 70
    assert all(agrees(config, made) for config in left_behind(run))


def test_a_configuration_that_was_cut_short_is_told_and_the_checkpoints_taken_once_it_is_gone(run):
    file = run / ".hydra" / "config.yaml"
    text = file.read_text()
    for size in range(60, text.index("seed:"), 211):
        file.write_text(text[:size])
        with pytest.raises(InputError, match="damaged"):
            composition.composed("train", [f"resume={run}"])
    file.write_text(text.replace("seed: 3\n", ""))
    with pytest.raises(InputError, match="it lacks seed; remove .hydra/config.yaml"):
        composition.composed("train", [f"resume={run}"])
    file.unlink()
    assert composition.composed("train", [f"resume={run}"])["seed"] == 3


def test_a_run_where_nothing_can_be_written_is_refused_before_its_log_is_opened(run, monkeypatch):
    def forbidden(**_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(single.tempfile, "TemporaryFile", forbidden)
    with pytest.raises(InputError, match=f"resume is '{run}', where nothing can be written: Read-only file system"):
        single.checked([f"resume={run}"], "train", training_run)


def test_a_finished_run_without_configuration_is_left_with_its_own(run, tmp_path):
    shutil.rmtree(run / ".hydra")
    ended = completed(f"resume={run}", cwd=tmp_path)
    assert "is finished" in ended.stdout
    assert all(agrees(config, own(run)) for config in left_behind(run))
    assert saved_configuration(run)["problem"]["_target_"].endswith("Torus")


def test_a_refused_resume_leaves_no_configuration(run, tmp_path):
    shutil.rmtree(run / ".hydra")
    assert "seed" in train(f"resume={run}", "seed=4", cwd=tmp_path).sentence
    assert not (run / ".hydra").exists()


def test_what_a_killed_resume_wrote_is_not_taken_for_the_runs(run, tmp_path):
    """Hydra writes what was asked for before the run can say what it is."""
    shutil.rmtree(run / ".hydra")
    (run / ".hydra").mkdir()
    asked = {"resume": str(run), "problem": {"_target_": "ocp_torch.problems.Circle"}, "seed": 0}
    (run / ".hydra" / "config.yaml").write_text(yaml.safe_dump(asked))
    assert saved_configuration(run)["seed"] == 3
    completed(f"resume={run}", "trainer.steps=65", cwd=tmp_path)
    assert all(agrees(c, own(run)) for c in [saved_configuration(run)])


def test_a_bare_checkpoint_goes_on_in_a_folder_of_its_own_name(run, tmp_path):
    bare = tmp_path / "somewhere.pt"
    shutil.copy(run / "checkpoints" / "last.pt", bare)
    elsewhere = lambda: setattr(composition, "CHECKOUT", tmp_path)
    completed(f"resume={bare}", "trainer.steps=70", cwd=tmp_path, before=elsewhere)
    (group,) = (tmp_path / "outputs").iterdir()
    assert group.name == "torus_dual"
    (folder,) = group.iterdir()
    made = load_checkpoint(bare)["config"]
    assert own(folder) == {**made, "trainer": {**made["trainer"], "steps": 70}}
    assert all(agrees(config, made) for config in left_behind(folder))
    assert load_checkpoint(bare)["step"] == 60  # and it stays as it was
