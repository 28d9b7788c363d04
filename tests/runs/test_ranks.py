"""Runs that several processes share are those of one, up to the order of summation; and end with a sentence and a checkpoint
whatever befalls one of them."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from ocp_torch.cli.explain import CHECKOUT
from ocp_torch.training.checkpoint import load_checkpoint
from support.bits import differences
from support.forked import TINY, certificate_in, completed, slowly
from support.processes import descendants, linux, wait_until
from support.shared import ended, shared

# Not SOAP: its eigenbases make 1e-2 of a last digit within ten steps, also in one process.
EXACT = (*TINY, "trainer.dtype=float64", "optimizer=adam")
WAYS = {
    "dual": (),
    "primal": ("method=primal", "stepper=extragradient"),
    "pd": ("method=pd", "method.density_batch=4", "sampler.visited=0.25", "trainer.evaluate_every=20"),
    "pd, coupled": ("method=pd", "method.coupling=1", "stepper=extragradient", "optimizer=sgd", "problem.noise=0.01"),
    "warm start": ("warm_start.mode=on", "warm_start.rounds=3", "warm_start.pieces=16", "warm_start.steps=4"),
    "two rounds": ("trainer.rounds=2", "trainer.good_gap=1e-6", "trainer.steps=20", "trainer.evaluate_every=10"),
    "target gap": ("trainer.target_gap=1e-3", "trainer.evaluate_every=10", "certificate.trajectories=8", "method=pd"),
    "importance": ("method=pd", "sampler=importance", "sampler.every=10", "sampler.pool=64", "method.density_batch=8"),
}
# Of weights, which are about 1, after 60 steps in double precision.
ROUNDING = 1e-9


def files(folder):
    """The list of files of a run; those of TensorBoard are named after the process."""
    names = [str(p.relative_to(folder)) for p in folder.rglob("*")]
    return sorted("events" if "tfevents" in name else name for name in names)


def last(folder):
    return load_checkpoint(folder / "checkpoints" / "last.pt")


def assert_same(folder, whole):
    """Weights and numbers of ``folder`` are those of ``whole`` to rounding, and all draws are the same."""
    one, other = last(folder), last(whole)
    for name, weights in one["fields"].items():
        torch.testing.assert_close(weights, other["fields"][name], rtol=ROUNDING, atol=ROUNDING)
    assert one["step"] == other["step"]
    assert one["samples"] == other["samples"]
    # Visited states and boxes of importance follow from the weights, and are the same as far as these are.
    follow = ("/states", "/sampler/boxes")
    assert [d for d in differences(one["batches"], other["batches"]) if not d.startswith(follow)] == []
    assert differences(one["generators"], other["generators"]) == []
    for side in ("lower", "upper"):
        for name, estimate in certificate_in(whole)[side].items():
            if estimate is not None:
                assert certificate_in(folder)[side][name]["value"] == pytest.approx(estimate["value"], rel=1e-6)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("way", "count"),
    [
        ("dual", 2),
        *(pytest.param(way, 2, marks=pytest.mark.nightly) for way in WAYS if way not in ("dual", "pd")),
        pytest.param("pd", 4, marks=pytest.mark.nightly),
    ],
)
def test_several_processes_make_the_run_of_one_up_to_the_order_of_summation(way, count, tmp_path):
    one, several = tmp_path / "one", tmp_path / "several"
    completed(*EXACT, *WAYS[way], f"hydra.run.dir={one}", cwd=tmp_path)
    first, *others = ended(shared(count, *EXACT, *WAYS[way], f"hydra.run.dir={several}", cwd=tmp_path))
    assert first.status == 0, first
    assert "controller from" in first.stdout
    for other in others:
        assert (other.status, other.stdout, other.stderr) == (0, "", "")
    assert_same(several, one)
    assert files(several) == files(one)


@pytest.mark.nightly
@pytest.mark.parametrize("counts", [(1, 2), (2, 1)])
def test_a_run_goes_on_with_another_number_of_processes(counts, tmp_path):
    whole, folder = tmp_path / "whole", tmp_path / "run"
    completed(*EXACT, *WAYS["pd"], f"hydra.run.dir={whole}", cwd=tmp_path)
    way = (*EXACT, *WAYS["pd"], f"hydra.run.dir={folder}")
    commands = shared(counts[0], *way, cwd=tmp_path, before=slowly)
    wait_until(lambda: "stepped 20" in commands[0].out.read_text() if commands[0].out.exists() else False)
    commands[0].send(signal.SIGTERM)
    assert [end.status for end in ended(commands)] == [143, 0][: counts[0]]
    assert 20 <= last(folder)["step"] < 60
    assert [end.status for end in ended(shared(counts[1], f"resume={folder}", cwd=tmp_path))] == [0] * counts[1]
    assert_same(folder, whole)


def interrupted(folder, rank, number, tmp_path, way=EXACT):
    """How two processes ended, of which one was sent a signal in the middle."""
    commands = shared(2, *way, f"hydra.run.dir={folder}", cwd=tmp_path, before=slowly)
    wait_until(lambda: "stepped 13" in commands[rank].out.read_text() if commands[rank].out.exists() else False)
    commands[rank].send(number)
    start = time.monotonic()
    ends = ended(commands)
    assert time.monotonic() - start < 30.0
    assert not any("Traceback" in end.stdout + end.stderr for end in ends)
    return ends


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.nightly)])
def test_a_signal_to_one_process_ends_all_after_the_same_step_and_is_saved(number, tmp_path):
    folder = tmp_path / "run"
    first, other = interrupted(folder, 1, number, tmp_path)
    steps = [[line for line in end.stdout.splitlines() if line.startswith("stepped")] for end in (first, other)]
    assert steps[0] == steps[1]
    assert (first.status, other.status) == (128 + number, 0)
    assert f"stopped by {signal.Signals(number).name}, saved" in first.stdout
    assert f"stepped {last(folder)['step']}" == steps[0][-1]


@pytest.mark.nightly
@pytest.mark.parametrize("stepper", ["simultaneous", "extragradient"])
def test_a_process_that_is_killed_costs_the_step_in_hand(stepper, tmp_path):
    way, folder, whole = (*EXACT, f"stepper={stepper}", "sampler=uniform"), tmp_path / "run", tmp_path / "whole"
    first, _ = interrupted(folder, 1, signal.SIGKILL, tmp_path, way)
    assert "another process of this run died, at step" in first.sentence
    assert "go on with" in first.sentence
    assert last(folder)["step"] >= 13
    completed(f"resume={folder}", cwd=tmp_path)
    completed(*way, f"hydra.run.dir={whole}", cwd=tmp_path)
    assert_same(folder, whole)


@pytest.mark.nightly
def test_the_death_of_the_first_process_ends_the_others_with_a_sentence(tmp_path):
    folder = tmp_path / "run"
    _, other = interrupted(folder, 0, signal.SIGKILL, tmp_path)
    assert "the first process of this run died, at step" in other.sentence
    assert last(folder)["step"] == 10
    assert not (folder / "certificate.json").exists()


def broken():
    """In the child: from the 20th batch on the problem fails, in the second process alone."""
    from ocp_torch.errors import ProblemError
    from ocp_torch.training.batches import Batches

    draw, drawn = Batches.draw, [0]

    def drew(batches, phase):
        drawn[0] += 1
        if os.environ["RANK"] == "1" and drawn[0] == 20:
            raise ProblemError("state_cost fails here.")
        return draw(batches, phase)

    Batches.draw = drew


@pytest.mark.nightly
def test_what_fails_in_another_process_is_told_by_the_first_which_hands_out_what_there_is(tmp_path):
    folder = tmp_path / "run"
    first, other = ended(shared(2, *EXACT, f"hydra.run.dir={folder}", cwd=tmp_path, before=broken))
    assert "state_cost fails here" in first.sentence
    assert "step 19" in first.sentence
    assert (other.status, other.stderr) == (0, "")
    assert (folder / "controller.safetensors").exists()


def hurried():
    """In the child: the second process finds the first gone once they are connected."""
    import torch.distributed as dist

    wait = dist.barrier

    def left_alone(*args, **kwargs):
        wait(*args, **kwargs)
        time.sleep(1.0)
        raise RuntimeError("Connection closed by peer")

    if os.environ["RANK"] == "1":
        dist.barrier = left_alone


def test_who_finds_the_first_gone_when_it_has_joined_leaves_as_well(tmp_path):
    first, other = ended(shared(2, *EXACT, "-m", "seed=0,1", cwd=tmp_path, before=hurried))
    assert "share a single run" in first.sentence
    assert (other.status, other.stdout, other.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        (("trainer.batch=15",), "trainer.batch is 15, which 2 processes cannot share equally"),
        (("-m", "seed=0,1"), "share a single run"),
        (("trainer.batch=x",), "trainer.batch"),
    ],
)
def test_what_processes_cannot_share_is_refused_by_the_first_alone(asked, words, tmp_path):
    first, other = ended(shared(2, *EXACT, *asked, f"hydra.run.dir={tmp_path / 'run'}", cwd=tmp_path))
    assert words in first.sentence
    assert (other.status, other.stdout, other.stderr) == (0, "", "")
    assert not (tmp_path / "run").exists()


def torchrun(*arguments, cwd):
    """The real one, and a file with what it prints."""
    out = cwd / "out"
    python = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command = [*python, str(CHECKOUT / "scripts" / "train.py"), *arguments]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    with out.open("w") as file:
        return subprocess.Popen(command, cwd=cwd, stdout=file, stderr=subprocess.STDOUT, env=environment), out


LONG = ("trainer.steps=100000", "trainer.checkpoint_every=50")


def rank_of(process):
    with open(f"/proc/{process}/environ") as file:
        return dict(line.partition("=")[::2] for line in file.read().split("\0")).get("RANK")


@linux
@pytest.mark.nightly
@pytest.mark.parametrize(("rank", "words"), [(None, "stopped by SIGTERM"), ("1", "another process"), ("0", "first")])
def test_torchrun_ends_in_a_sentence_with_a_checkpoint(rank, words, tmp_path):
    folder = tmp_path / "run"
    run, out = torchrun(*EXACT, *LONG, f"hydra.run.dir={folder}", cwd=tmp_path)
    wait_until((folder / "checkpoints" / "last.pt").exists)
    processes = {rank_of(p): p for p in descendants(run.pid)}
    os.kill(run.pid if rank is None else processes[rank], signal.SIGTERM if rank is None else signal.SIGKILL)
    assert run.wait(60.0) != 0
    assert words in out.read_text()
    assert 50 <= last(folder)["step"] < 100000


@pytest.mark.nightly
def test_torchrun_makes_a_run_in_one_folder(tmp_path):
    folder = tmp_path / "run"
    run, out = torchrun(*EXACT, *WAYS["pd"], f"hydra.run.dir={folder}", cwd=tmp_path)
    assert run.wait(300.0) == 0, out.read_text()
    assert out.read_text().count("controller from") == 1
    assert json.loads((folder / "certificate.json").read_text())["step"] == 60


def dying():
    """In the child: the second process dies over its first piece of the certificate."""
    from ocp_torch.compute.processes import ProcessGroup

    if os.environ["RANK"] == "1":
        ProcessGroup._attempted = lambda *_: os._exit(1)


@pytest.mark.nightly
def test_a_death_while_the_certificate_is_made_ends_the_run_with_a_sentence_and_a_resume_makes_it(tmp_path):
    folder = tmp_path / "run"
    way = (*TINY, "certificate.trajectories=1024", f"hydra.run.dir={folder}")
    first, _ = ended(shared(2, *way, cwd=tmp_path, before=dying))
    assert "another process of this run died" in first.sentence
    assert "go on with" in first.sentence
    assert "Traceback" not in first.stdout + first.stderr
    assert not (folder / "certificate.json").exists()
    completed(f"resume={folder}", cwd=tmp_path)
    assert certificate_in(folder)["gap"]["simulated"] is not None
