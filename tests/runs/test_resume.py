"""A resumed run is the uninterrupted one to the bit; what may change at a resume changes as documented."""

import itertools
import json
import os
import time

import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ocp_torch.cli.compose import composed
from ocp_torch.errors import InputError
from ocp_torch.runs.build import build_trainer
from ocp_torch.runs.configuration import saved_configuration
from ocp_torch.runs.resume import find_run
from ocp_torch.runs.run import train as start
from ocp_torch.runs.run import training_run
from ocp_torch.training.checkpoint import load_checkpoint, save_checkpoint
from ocp_torch.training.evaluator import Evaluator
from ocp_torch.training.monitor import Observer
from support.bits import differences
from support.forked import TINY, completed, finished_run, train
from support.looks import quick
from support.small import METHODS, SMALL, configured, small, state_of

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")

STEPPERS, SAMPLERS, OPTIMIZERS = ("simultaneous", "extragradient"), ("uniform", "sobol"), ("soap", "adam", "sgd")
# Every method with every stepper; samplers and optimisers go round. (More combinations, once interrupted: test_training.)
WAYS = [
    (*METHODS[method], f"stepper={stepper}", f"sampler={SAMPLERS[k % 2]}", f"optimizer={OPTIMIZERS[k % 3]}")
    for k, (stepper, method) in enumerate(itertools.product(STEPPERS, METHODS))
]
# Those of the other stepper are nightly, but for one; test_training interrupts every method with each of them once.
NIGHTLY = WAYS[len(METHODS) + 1 :]
# Importance sampling, whose density is fitted anew before some of these steps and after others; also with noise.
IMPORTANCE = ("sampler=importance", "sampler.every=2", "sampler.pool=200")
WAYS += [(*METHODS[method], *IMPORTANCE) for method in ("dual", "primal, mu a network", "pd")]
WAYS += [("method=dual", "problem.noise=0.02", "stepper=extragradient", "sampler.visited=0.3", *IMPORTANCE)]


def maker(*overrides: str):
    """Makes the same trainer again and again; composing is what takes long."""
    config = configured(*SMALL, *overrides)
    return lambda **trainer: build_trainer({**config, "trainer": {**config["trainer"], **trainer}})


class Recorder(Observer):
    """Saves a checkpoint after each of ``steps``."""

    def __init__(self, folder, *steps: int) -> None:
        self.folder, self.steps = folder, steps

    def stepped(self, trainer, report, log):
        if trainer.step in self.steps:
            trainer.save(self.folder / f"{trainer.step}.pt")


@pytest.mark.nightly
@pytest.mark.parametrize(
    "way", [pytest.param(w, marks=pytest.mark.nightly) if w in NIGHTLY else w for w in WAYS], ids=" ".join
)
def test_from_any_step_a_resumed_run_reaches_the_same_bits(way, tmp_path):
    steps, made = (1, 4, 7), maker(*way, "trainer.steps=10")
    whole = made()
    whole.fit(Recorder(tmp_path, *steps))
    for step in steps:
        resumed = made()
        resumed.resume(tmp_path / f"{step}.pt")
        assert resumed.step == step
        resumed.fit(Observer())
        assert differences(state_of(resumed), state_of(whole)) == []
        rates = resumed.stepper.learning_rates()
        assert rates == whole.stepper.learning_rates()


def test_the_looks_so_far_are_part_of_the_state(monkeypatch, tmp_path):
    monkeypatch.setattr(Evaluator, "evaluate", quick(lambda t: abs(t.step - 10.0) / 100.0))
    way = ("method=dual", "trainer.evaluate_every=4")
    whole = small(*way)
    whole.fit(Recorder(tmp_path, 6, 13), tmp_path / "run" / "last.pt")
    assert whole.health.best.step == 8
    assert load_checkpoint(tmp_path / "run" / "best.pt")["step"] == 8
    for step, best in ((6, 4), (13, 8)):
        resumed = small(*way)
        resumed.resume(tmp_path / f"{step}.pt")
        assert resumed.health.best.step == best
        resumed.fit(Observer())
        assert differences(state_of(resumed), state_of(whole)) == []


def test_random_numbers_that_a_problem_draws_itself_are_resumed_too(monkeypatch, tmp_path):
    import random

    import numpy as np

    drawn = lambda: (torch.rand(2).tolist(), np.random.rand(2).tolist(), random.random())  # noqa: NPY002
    trainer = small("method=dual", "trainer.steps=2")
    trainer.save(tmp_path / "a.pt")
    wanted = drawn()
    assert drawn() != wanted
    small("method=dual", "trainer.steps=2").resume(tmp_path / "a.pt")
    assert drawn() == wanted


@pytest.mark.nightly
@pytest.mark.parametrize("schedule", ["cosine", "constant", "decay"])
@pytest.mark.parametrize("method", ["dual", "pd"])
def test_with_other_steps_a_run_is_one_of_the_new_length(method, schedule, tmp_path):
    """Learning rates and the warm start are, at every step, those of a run that had that length from the start."""
    way = (f"method={method}", f"schedule={schedule}", *(["schedule.every=3"] if schedule == "decay" else []))
    rates = lambda seen: type(
        "Rates", (Observer,), {"stepped": lambda _, t, r, log: seen.__setitem__(t.step, told(t))}
    )()
    told = lambda t: (t.stepper.learning_rates(), t.objective.needs_divergences(t.phase))
    made = maker(*way)
    made(steps=10).fit(Recorder(tmp_path, 8, 10))
    wanted = {steps: {} for steps in (24, 9, 6)}
    for steps, seen in wanted.items():
        made(steps=steps).fit(rates(seen))
    for begin, steps in ((10, 24), (8, 24), (8, 9), (10, 6)):
        seen = {}
        resumed = made(steps=steps)
        resumed.resume(tmp_path / f"{begin}.pt")
        resumed.fit(rates(seen))
        assert list(seen) == list(range(begin + 1, steps + 1))
        for step, (got, resting) in seen.items():
            assert got == pytest.approx(wanted[steps][step][0]), step
            assert resting == wanted[steps][step][1]


def test_the_round_follows_the_new_length(tmp_path):
    made = maker("method=dual")
    trainer = made(rounds=2, steps=4)
    trainer.state.round, trainer.state.step = 1, 10
    save_checkpoint(tmp_path / "a.pt", trainer.state.state_dict())
    for steps, rounds, wanted in ((4, 2, 1), (5, 2, 1), (20, 2, 0), (3, 3, 2), (2, 1, 0)):
        other = made(rounds=rounds, steps=steps)
        other.resume(tmp_path / "a.pt")
        assert other.state.round == wanted


def test_an_optimisers_settings_can_change_at_a_resume_and_its_moments_stay(tmp_path):
    way = ("method=dual", "optimizer=adam")
    small(*way).fit(Recorder(tmp_path, 10))
    other = small(*way, "optimizer.lr=1.0e-4", "optimizer.betas=[0.5, 0.6]", "schedule=constant")
    other.resume(tmp_path / "10.pt")
    assert other.stepper.learning_rates() == {"value": 1e-4}
    (group,) = other.stepper.optimizers["value"].param_groups
    assert tuple(group["betas"]) == (0.5, 0.6)
    moments = other.stepper.optimizers["value"].state_dict()["state"]
    saved = load_checkpoint(tmp_path / "10.pt")["stepper"]["optimizers"]["value"]["state"]
    assert differences(moments, saved) == []


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run from the command line."""
    return finished_run(tmp_path_factory.mktemp("finished") / "run", *TINY)


def resuming(folder, *overrides: str):
    """What `training_run` makes of a resume of ``folder``, or the sentence it is refused with."""
    try:
        return training_run(composed("train", [f"resume={folder}", *overrides])).trainer
    except InputError as error:
        return str(error)


CHANGES = {
    "seed=1": "seed is 1, but the run has 0",
    "model.width=9": "model.width is 9, but the run has 8",
    "problem.discount=3": "problem.discount is 3, but the run has 2.0",
    "method=pd": "method.name is 'pd', but the run has 'dual'",
    "optimizer=sgd": "optimizer.name is 'sgd'",
    "trainer.dtype=float64": "trainer.dtype",
    "experiment=debug": "experiment",
    "trainer.steps=0": "trainer.steps is 0",
    "trainer.stepz=5": "did you mean 'trainer.steps'?",
}


@pytest.mark.parametrize("override", CHANGES)
def test_what_a_resume_cannot_change_is_refused_by_name(override, finished):
    assert CHANGES[override] in resuming(finished, override)


def test_a_run_keeps_its_own_configuration_and_takes_what_the_command_line_names(finished):
    trainer = resuming(finished, "trainer.steps=90", "schedule=decay", "schedule.decay=0.5")
    assert (trainer.step, trainer.settings.steps, trainer.settings.batch) == (60, 90, 16)
    assert trainer.config["schedule"] == {"name": "decay", "decay": 0.5, "every": 20000}
    assert trainer.config["model"]["width"] == 8


def test_sizes_by_dimension_are_those_the_run_began_with(tmp_path, monkeypatch):
    """Defaults may change between two versions; a run does not."""
    import dataclasses

    from ocp_torch.fields import mlp
    from ocp_torch.training import budgets

    rest = [o for o in TINY if not o.startswith(("model.width", "trainer.batch"))]
    config = composed("train", [*rest, "trainer.steps=2"])
    run = training_run(config)
    run.trainer.fit(Observer(), tmp_path / "run" / "checkpoints" / "last.pt")
    (tmp_path / "run" / ".hydra").mkdir()
    (tmp_path / "run" / ".hydra" / "config.yaml").write_text(yaml.safe_dump(config))
    others = tuple(dataclasses.replace(b, batch=2 * b.batch) for b in budgets.BUDGETS)
    monkeypatch.setattr(budgets, "BUDGETS", others)
    monkeypatch.setattr(mlp, "SIZES", {dim: {**sizes, "width": sizes["width"] + 8} for dim, sizes in mlp.SIZES.items()})
    trainer = resuming(tmp_path / "run")
    assert trainer.config == run.trainer.config


def test_a_finished_run_says_so_and_more_steps_go_on_in_its_own_folder(finished, tmp_path):
    first = {p.name: p.read_bytes() for p in (finished / ".hydra").iterdir() if p.is_file()}
    before = (finished / "certificate.json").read_bytes()
    ended = completed(f"resume={finished}", cwd=tmp_path)
    assert "is finished" in ended.stdout
    assert (finished / "certificate.json").read_bytes() == before
    ended = completed(f"resume={finished}/checkpoints/last.pt", "trainer.steps=70", cwd=tmp_path)
    assert "going on from step 60" in ended.stdout
    assert json.loads((finished / "certificate.json").read_text())["step"] == 70
    assert {p.name: p.read_bytes() for p in (finished / ".hydra").iterdir() if p.is_file()} == first
    assert [p.name for p in sorted((finished / ".hydra").glob("resume_*"))] == ["resume_1", "resume_2"]
    assert resuming(finished).settings.steps == 70  # what the last start was told holds for the next
    events = EventAccumulator(str(finished))
    events.Reload()
    assert [e.step for e in events.Scalars("loss/value")] == list(range(5, 75, 5))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly
def test_auto_finds_the_last_run_of_this_configuration_or_starts_it(finished, tmp_path):
    folder = tmp_path / "runs" / "mine"
    way = (*TINY, "seed=7", "trainer.steps=5", f"hydra.run.dir={folder}", "resume=auto")
    completed(*way, cwd=tmp_path)
    assert json.loads((folder / "certificate.json").read_text())["step"] == 5
    again = completed(*way, cwd=tmp_path)
    assert "is finished" in again.stdout
    os.remove(folder / "certificate.json")
    again = train(*way, cwd=tmp_path)
    assert "going on from step 5" in again.stdout
    assert [p.name for p in (tmp_path / "runs").iterdir()] == ["mine"]
    other = training_run(composed("train", [*way[:-2], "resume=auto", "trainer.batch=17"], roots=(folder,)))
    assert other.trainer.step == 0


def test_a_new_run_does_not_overwrite_one_that_is_there(finished, tmp_path):
    before = {p: p.stat().st_mtime_ns for p in finished.rglob("*")}
    ended = train(*TINY, f"hydra.run.dir={finished}", cwd=tmp_path)
    assert f"resume={finished}" in ended.sentence
    assert {p: p.stat().st_mtime_ns for p in finished.rglob("*")} == before


def test_a_start_killed_while_its_configuration_was_written_is_no_obstacle(tmp_path):
    """The first start's file is cut short; the second, which gets going, counts; a third's is cut at any place."""
    folder, config = tmp_path / "run", composed("train", [*TINY, "trainer.steps=2"])
    text = yaml.safe_dump(config, sort_keys=False)
    first, second, third = (folder / ".hydra" / part / "config.yaml" for part in ("", "resume_1", "resume_2"))
    for file, size in ((first, len(text) // 2), (second, len(text))):
        file.parent.mkdir(parents=True)
        file.write_text(text[:size])
    start(training_run(dict(config)), folder)
    assert saved_configuration(folder) == config
    third.parent.mkdir()
    asked = yaml.safe_dump({**config, "resume": str(folder)}, sort_keys=False)
    for size in (*range(0, len(asked), 97), *range(len(asked) - len(str(folder)) - 12, len(asked) + 1)):
        third.write_text(asked[:size])
        assert saved_configuration(folder) == config
    assert find_run(config, (tmp_path,)) == folder
    assert first.read_text() == text[: len(text) // 2]


OWN = """
import pathlib
pathlib.Path({canary!r}).touch()
import torch
from ocp_torch import Problem

class Mine(Problem):
    def __init__(self, height=0.5):
        super().__init__(dim=1)
        self.height = height

    def state_cost(self, x):
        return torch.full_like(x[:, 0], float(self.height))
"""


@pytest.mark.nightly
def test_a_problem_of_your_own_is_not_imported_for_a_file_but_must_be_named_again(tmp_path):
    canary, folder = tmp_path / "canary", tmp_path / "run"
    name = f"own_{time.monotonic_ns()}"
    (tmp_path / f"{name}.py").write_text(OWN.format(canary=str(canary)))
    mine = f"problem._target_={name}.Mine"
    completed(*TINY, mine, "+problem.height=0.25", "trainer.steps=4", f"hydra.run.dir={folder}", cwd=tmp_path)
    canary.unlink()
    refused = train(f"resume={folder}", "trainer.steps=6", cwd=tmp_path)
    assert f"{name}.Mine" in refused.sentence
    assert "problem._target_=my_module.MyProblem" in refused.sentence
    assert not canary.exists()
    completed(f"resume={folder}", "trainer.steps=6", mine, cwd=tmp_path)
    assert canary.exists()
    assert json.loads((folder / "certificate.json").read_text())["step"] == 6
