"""Runs of every method, and of a simulator with its processes, killed at random moments and at each step of their end: what
they leave is what an uninterrupted run leaves, to the bit, and no process outlives them."""

import os
import random
import signal
import textwrap
import time

import pytest
from PIL import Image

from support.forked import TINY, Command, completed, slowly, train
from support.processes import alive, descendants, linux, wait_until
from support.run_folders import assert_same_run

# How many chains of kills for each kind of run.
KILLS = int(os.environ.get("OCP_TORCH_KILLS", "1"))
RUN = (
    *TINY,
    "trainer.figures=true",
    "trainer.evaluate_every=20",
    "certificate.trajectories=2",
    "certificate.tolerance=0.01",
    "certificate.stage.steps=5",
)
SIMULATOR = """
import numpy as np

def swing(x):
    return 1.0 - np.cos(2 * np.pi * x[:, 0]), None, np.ones((len(x), 1, 1))
"""
WAYS = {
    "dual": (*RUN, "method=dual"),
    "primal": (*RUN, "method=primal"),
    "pd": (*RUN, "method=pd"),
    "a simulator": (*RUN, "problem=callable", "problem.target=swings:swing", "problem.dim=1", "problem.workers=2"),
    "numbers of its own": (*RUN, "problem=double_integrator", "trainer.evaluate_every=0", "trainer.steps=20"),
}


def assert_same(folder, whole) -> None:
    assert_same_run(folder, whole)
    figures = list(folder.glob("figures/*.png"))
    assert figures
    for file in figures:
        Image.open(file).verify()
    assert "is finished" in train(f"resume={folder}", *own(folder), cwd=folder.parent).stdout


def own(folder) -> tuple[str, ...]:
    """What only the command line may name."""
    simulated = "target: swings:swing" in (folder / ".hydra" / "config.yaml").read_text()
    return tuple(o for o in WAYS["a simulator"] if o.startswith("problem")) if simulated else ()


@pytest.fixture(scope="module")
def wholes(tmp_path_factory):
    """Uninterrupted runs, made when they are asked for, and the seconds they took."""
    made = {}

    def whole(way: str):
        if way not in made:
            folder = tmp_path_factory.mktemp("whole") / "run"
            (folder.parent / "swings.py").write_text(textwrap.dedent(SIMULATOR))
            start = time.monotonic()
            completed(*WAYS[way], f"hydra.run.dir={folder}", cwd=folder.parent, before=slowly)
            made[way] = folder, time.monotonic() - start
        return made[way]

    return whole


@linux
@pytest.mark.nightly
@pytest.mark.parametrize("chain", range(KILLS))
@pytest.mark.parametrize("way", ["pd", "a simulator"])
def test_killed_again_and_again_a_run_leaves_what_it_would_have_left(way, chain, wholes, tmp_path):
    """Killed outright or asked to stop at up to three random moments, by `resume` once there is something to go on from."""
    whole, seconds = wholes(way)
    (tmp_path / "swings.py").write_text(textwrap.dedent(SIMULATOR))
    folder, chance, known = tmp_path / "run", random.Random(f"{way} {chain}"), set()
    for start in range(20):
        going_on = (folder / "checkpoints" / "last.pt").exists()
        words = (f"resume={folder}", *own(folder)) if going_on else (*WAYS[way], f"hydra.run.dir={folder}")
        command = Command("train", *words, cwd=tmp_path, before=slowly)
        deadline = time.monotonic() + (chance.uniform(0.02, 1.0) * seconds if start < 3 else 600.0)
        while time.monotonic() < deadline and command.running:
            known |= descendants(command.process)
            time.sleep(0.005)
        command.send(chance.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGTERM)))
        ended = command.wait()
        assert ended.status in (0, 137, 143), ended
        wait_until(lambda known=known: not alive(known), 5.0)
        if ended.status == 0:
            break
    print(f"{way}, chain {chain}: {start} interruptions")
    assert known or way != "a simulator"  # its workers; other runs have copies of themselves at times
    assert_same(folder, whole)


def killed_in(name: str):
    """In the child: no further than the middle of this step of the end."""

    def before():
        from ocp_torch.runs import canvas, finish, run
        from ocp_torch.training import monitor

        def die(*_, **__):
            os.kill(os.getpid(), signal.SIGKILL)

        def half_a_figure(drawn, folder):
            folder.mkdir(exist_ok=True)
            (folder / f"{next(iter(drawn))}.png").write_bytes(b"\x89PNG half")
            die()

        def half_the_points(writer, certificate, step):
            writer.add_scalar("gap/certified", 0.5, step)
            writer.flush()
            die()

        where, what, how = {
            "figures": (canvas, "save", half_a_figure),
            "points": (monitor, "record", half_the_points),
            "metrics": (run, "write_metrics", die),
            "the last of it": (run, "complete", die),
            "the controller": (finish, "controller_of", die),
        }[name]
        setattr(where, what, how)

    return before


@pytest.mark.nightly
@pytest.mark.parametrize("step", ["the controller", "figures", "the last of it"])
def test_killed_while_its_last_files_are_written_a_resume_makes_what_is_missing(step, wholes, tmp_path):
    whole, _ = wholes("numbers of its own")
    folder = tmp_path / "run"
    way = WAYS["numbers of its own"]
    assert train(*way, f"hydra.run.dir={folder}", cwd=tmp_path, before=killed_in(step)).status == 137
    assert (folder / "certificate.json").exists() == (step != "the controller")
    ended = completed(f"resume={folder}", cwd=tmp_path)
    assert "is finished" not in ended.stdout
    assert_same(folder, whole)


@pytest.mark.nightly
@pytest.mark.parametrize("lost", ["figures/motion.png", "controller.safetensors", "report.html"])
def test_what_was_lost_of_a_finished_run_is_made_again(lost, wholes, tmp_path):
    whole, _ = wholes("numbers of its own")
    before = (whole / lost).stat().st_size
    (whole / lost).unlink()
    ended = completed(f"resume={whole}", cwd=tmp_path)
    assert f"lacks {lost}; what is missing is made" in ended.stdout
    assert (whole / lost).stat().st_size == before
