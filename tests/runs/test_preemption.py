"""Runs stopped by real signals at any moment: nothing is lost, the status is the conventional one, and the end the same."""

import math
import os
import random
import signal
import time

import pytest

from ocp_torch.training.checkpoint import load_checkpoint, newest
from support.forked import TINY, Command, completed, slowly, train
from support.run_folders import assert_same_run

# How many kills at random moments; the few of every run of the tests can be made many.
KILLS = int(os.environ.get("OCP_TORCH_KILLS", "2"))
RUN = (*TINY, "sampler=sobol", "stepper=extragradient")


def patiently():
    """In the child: certification takes long, and says when it begins."""
    from ocp_torch.training.trainer import Trainer

    certify = Trainer.certify

    def slow(trainer, settings, *arguments, **named):
        print("certifying", flush=True)
        time.sleep(600.0)
        return certify(trainer, settings, *arguments, **named)

    Trainer.certify = slow


def wait_for(command: Command, words: str) -> None:
    deadline = time.monotonic() + 900.0
    while words not in (command.out.read_text() if command.out.exists() else ""):
        assert time.monotonic() < deadline
        assert command.running, command.err.read_text()
        time.sleep(0.02)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The uninterrupted run, and how long it took."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    start = time.monotonic()
    completed(*RUN, f"hydra.run.dir={folder}", cwd=folder.parent, before=slowly)
    return folder, time.monotonic() - start


@pytest.mark.nightly
@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_the_step_saves_and_says_how_to_go_on(number, status, whole, tmp_path):
    folder = tmp_path / "a run, with 'signs' = in it"
    quoted = str(folder).replace("'", "\\'")
    command = Command("train", *RUN, f"hydra.run.dir='{quoted}'", cwd=tmp_path, before=slowly)
    wait_for(command, "stepped 13")
    command.send(number)
    ended = command.wait()
    assert ended.status == status, ended
    assert "Traceback" not in ended.stdout + ended.stderr
    last = [int(line.split()[1]) for line in ended.stdout.splitlines() if line.startswith("stepped")][-1]
    assert load_checkpoint(folder / "checkpoints" / "last.pt")["step"] == last < 60
    (line,) = [line for line in ended.stdout.splitlines() if "go on with" in line]
    assert signal.Signals(number).name in line
    assert "resume=" in line
    assert not (folder / "certificate.json").exists()
    completed(f"resume='{quoted}'", cwd=tmp_path)
    assert_same_run(folder, whole[0])


@pytest.mark.nightly
def test_a_signal_during_certification_finds_the_training_saved(whole, tmp_path):
    folder = tmp_path / "run"
    command = Command("train", *RUN, f"hydra.run.dir={folder}", cwd=tmp_path, before=patiently)
    wait_for(command, "certifying")
    command.send(signal.SIGTERM)
    assert command.wait().status == 143
    assert not (folder / "certificate.json").exists()
    assert load_checkpoint(folder / "checkpoints" / "last.pt")["step"] == 60
    completed(f"resume={folder}", cwd=tmp_path)
    assert_same_run(folder, whole[0])


def stuck():
    """In the child: the third step never ends by itself."""
    from ocp_torch.training.trainer import Trainer

    step = Trainer._advance

    def advance(trainer, monitor, checkpoint):
        step(trainer, monitor, checkpoint)
        print("stepped", trainer.step, flush=True)
        while trainer.step == 13:
            time.sleep(0.01)

    Trainer._advance = advance


@pytest.mark.nightly
def test_a_second_signal_stops_at_once_and_costs_no_more_than_the_time_since_the_last_checkpoint(whole, tmp_path):
    folder = tmp_path / "run"
    command = Command("train", *RUN, f"hydra.run.dir={folder}", cwd=tmp_path, before=stuck)
    wait_for(command, "stepped 13")
    command.send(signal.SIGINT)
    time.sleep(0.3)
    assert command.running
    command.send(signal.SIGTERM)
    assert command.wait().status == 143
    assert load_checkpoint(folder / "checkpoints" / "last.pt")["step"] == 10
    completed(f"resume={folder}", cwd=tmp_path)
    assert_same_run(folder, whole[0])


@pytest.mark.nightly
@pytest.mark.parametrize("kill", range(KILLS))
def test_killed_at_random_moments_a_run_loses_at_most_what_came_after_its_last_checkpoint(kill, whole, tmp_path):
    """Killed outright, or asked to stop, six times at most; then left to reach the end."""
    folder, chance = tmp_path / "run", random.Random(kill)
    way, starts, reached = [*RUN, f"hydra.run.dir={folder}", "resume=auto"], 0, 0
    while True:
        starts += 1
        number = chance.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGTERM))
        command = Command("train", *way, cwd=tmp_path, before=slowly)
        moment = chance.uniform(0.05, 1.2) * whole[1] if starts <= 6 else math.inf
        deadline = time.monotonic() + moment
        while time.monotonic() < deadline and command.running:
            time.sleep(0.002)
        command.send(number)
        ended = command.wait()
        steps = [int(line.split()[1]) for line in ended.stdout.splitlines() if line.startswith("stepped ")]
        seen = max(steps, default=reached)
        assert ended.status in (0, 137, 143), ended
        if ended.status == 0:
            break
        if (folder / "checkpoints" / "last.pt").exists():
            saved = newest(folder / "checkpoints")[0]["step"]
            assert saved >= max(reached, seen - seen % 10)
            reached = saved
    print(f"kill {kill}: interrupted {starts - 1} times")
    ended = train(f"resume={folder}", cwd=tmp_path)
    assert "is finished" in ended.stdout
    assert_same_run(folder, whole[0])
