"""Sweeps run unattended: jobs end alone, leave nothing to the next, go on when called again, and run side by side."""

import json
import random
import time

import pytest
import torch

from ocp_torch.cli.job import isolated
from ocp_torch.training.checkpoint import load_checkpoint
from support.bits import differences
from support.forked import TINY, completed, train

# Problems that misbehave: one fails in the middle of training, the other leaves the process changed.
MODULE = """
import random
import numpy, torch
from ocp_torch import Problem

class Flat(Problem):
    def __init__(self, mood="good"):
        super().__init__(dim=1)
        self.mood, self.calls = mood, 0

    def state_cost(self, x):
        self.calls += 1
        if self.mood == "failing" and self.calls > 250:
            raise RuntimeError("two\\nlines")
        if self.mood == "messy":
            torch.set_default_dtype(torch.float64)
            torch.manual_seed(int(random.random() * 1e6)); numpy.random.seed(3); random.seed(5)
        return 0.5 + 0.1 * torch.cos(6.283185307179586 * x[:, 0])
"""


def certificate_in(folder) -> dict:
    return json.loads((folder / "certificate.json").read_text())


@pytest.fixture
def mine(tmp_path):
    name = f"moods_{time.monotonic_ns()}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    return f"problem._target_={name}.Flat"


def test_a_job_leaves_threads_precision_and_generators_as_they_were():
    """In this process: OpenMP must not get more threads in a fork of one that has used them."""
    torch.manual_seed(3)
    random.seed(3)
    expected = torch.rand(1), random.random()
    torch.manual_seed(3)
    random.seed(3)
    threads = torch.get_num_threads()
    with isolated():
        torch.set_num_threads(threads + 1)
        torch.set_default_dtype(torch.float64)
        torch.manual_seed(5)
        random.seed(5)
    assert torch.get_num_threads() == threads
    assert torch.get_default_dtype() is torch.float32
    assert (torch.rand(1), random.random()) == expected


@pytest.mark.nightly
def test_whatever_a_job_does_the_others_run_as_if_alone_and_it_is_named(mine, tmp_path):
    sweep = tmp_path / "sweep"
    way = (*TINY, mine, "trainer.steps=8", f"hydra.sweep.dir={sweep}")
    ended = train("-m", *way, "+problem.mood=messy,failing,good", cwd=tmp_path)
    assert ended.status == 2, ended
    assert "Traceback" not in ended.stdout + ended.stderr
    errors = [line for line in ended.stderr.splitlines() if line.startswith("error: ")]
    assert "RuntimeError: two lines" in errors[0]
    assert "problem.mood=failing" in errors[0]
    assert "1 job(s)" in errors[-1]
    assert "problem.mood=failing" in errors[-1]
    folders = {p.name[0]: p for p in sweep.iterdir() if p.is_dir()}
    assert folders.keys() == {"0", "1", "2"}
    assert all(p.name.endswith("_flat_dual_seed0") for p in folders.values())
    assert not (folders["1"] / "certificate.json").exists()
    assert "RuntimeError: two lines" in (folders["1"] / "train.log").read_text()
    alone = tmp_path / "alone"
    completed(*way[:-1], "+problem.mood=good", f"hydra.run.dir={alone}", cwd=tmp_path)
    states = [load_checkpoint(f / "checkpoints" / "last.pt") for f in (folders["2"], alone)]
    assert differences(*([s[k] for k in ("fields", "average", "generators")] for s in states)) == []
    # The same sweep again: what is finished stays, what failed is tried again.
    before = {k: f.stat().st_mtime_ns for k in "02" for f in [folders[k] / "certificate.json"]}
    ended = train("-m", *way, "+problem.mood=messy,failing,good", "resume=auto", cwd=tmp_path)
    assert ended.status == 2, ended
    assert ended.stdout.count("is finished") == 2
    assert before == {k: (folders[k] / "certificate.json").stat().st_mtime_ns for k in "02"}
    assert {p.name[0]: p for p in sweep.iterdir() if p.is_dir()} == folders


@pytest.mark.nightly
def test_a_sweep_of_resumes_goes_on_in_each_runs_own_folder(tmp_path):
    runs = [tmp_path / "runs" / name for name in "ab"]
    for run in runs:
        completed(*TINY, "trainer.steps=4", f"hydra.run.dir={run}", cwd=tmp_path)
    sweep = tmp_path / "sweep"
    several = ",".join(map(str, runs))
    completed("-m", f"resume={several}", "trainer.steps=6", f"hydra.sweep.dir={sweep}", cwd=tmp_path)
    for run in runs:
        assert certificate_in(run)["step"] == 6
        assert (run / ".hydra" / "resume_1" / "config.yaml").exists()
        assert "going on from step 4" in (run / "train.log").read_text()
    assert [p.name for p in sweep.iterdir()] == ["multirun.yaml"]


@pytest.mark.nightly
def test_jobs_run_side_by_side_and_as_on_a_cluster_with_the_same_end(tmp_path):
    """Submitit's local executor stands for that of a cluster: a process of its own for each job, from pickles."""
    way = (*TINY, "trainer.steps=4", "seed=0,1", "problem.discount=-1,2")
    launchers = {
        "basic": (),
        "joblib": ("hydra.launcher.n_jobs=2",),
        "submitit_local": ("hydra.launcher.cpus_per_task=1",),
    }
    statuses = []
    for name, more in launchers.items():
        sweep = f"hydra.sweep.dir={tmp_path / name}"
        ended = train("-m", *way, sweep, f"hydra/launcher={name}", *more, cwd=tmp_path)
        statuses.append((ended.status, ended.stderr.splitlines()[-1]))
    assert statuses == [statuses[0]] * 3
    assert statuses[0][0] == 2
    for job in ("1_circle_dual_seed0", "3_circle_dual_seed1"):
        found = [certificate_in(tmp_path / name / job) | {"train_seconds": 0} for name in launchers]
        assert found == [found[0]] * 3
    assert not list(tmp_path.glob(".ocp_torch_*"))
