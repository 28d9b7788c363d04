"""Damaged checkpoints are named and the newest good one is used; a disk that is full costs nothing that was saved."""

import errno
import os
import resource
from pathlib import Path

import pytest
import torch

from ocp_torch import train as from_python
from ocp_torch.cli.compose import composed
from ocp_torch.errors import InputError, StorageError
from ocp_torch.files import storage
from ocp_torch.runs.run import training_run
from ocp_torch.training.checkpoint import MAGIC, SCHEMA, load_checkpoint, newest, save_checkpoint
from ocp_torch.training.monitor import Observer
from support.forked import TINY, completed, train
from support.small import small

pytestmark = pytest.mark.usefixtures("quick_composition")

STATES = [{"step": k, "weights": torch.arange(100.0) + k} for k in range(6)]


def steps_in(folder: Path) -> dict[str, int]:
    return {p.name: load_checkpoint(p)["step"] for p in sorted(folder.iterdir())}


def flipped(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]


def foreign(_: bytes) -> bytes:
    torch.save({"weights": torch.zeros(2)}, "foreign.pt")
    content = Path("foreign.pt").read_bytes()
    os.remove("foreign.pt")
    return content


DAMAGES = {
    "empty": (lambda content: b"", "first bytes are damaged"),
    "truncated": (lambda content: content[: len(content) // 2], "does not match|do not match"),
    "cut in its header": (lambda content: content[:20], "first bytes are damaged"),
    "a flipped bit": (flipped, "do not match"),
    "zeros": (lambda content: bytes(len(content)), "first bytes are damaged"),
    "foreign": (foreign, "is not a checkpoint of ocp_torch"),
    "future schema": (lambda content: content.replace(f"{MAGIC} {SCHEMA}".encode(), f"{MAGIC} 99".encode(), 1), "99"),
    "old schema": (
        lambda content: content.replace(f"{MAGIC} {SCHEMA}".encode(), f"{MAGIC} 1".encode(), 1),
        "schema '1'",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_named_in_one_sentence_and_the_newest_good_one_is_used(damage, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "checkpoints"
    for state in STATES[:3]:
        save_checkpoint(folder / "last.pt", state, keep=3)
    hurt, words = DAMAGES[damage]
    (folder / "last.pt").write_bytes(hurt((folder / "last.pt").read_bytes()))
    with pytest.raises(InputError, match=words) as refused:
        load_checkpoint(folder / "last.pt")
    assert str(folder / "last.pt") in str(refused.value)
    state, path, notes = newest(folder)
    assert (state["step"], path.name) == (1, "last-1.pt")
    assert notes == [str(refused.value)]
    assert notes[0].count("\n") == 0
    for name in ("last-1.pt", "last-2.pt"):
        (folder / name).write_bytes(b"")
    save_checkpoint(folder / "best.pt", STATES[5])
    assert newest(folder)[1].name == "best.pt"
    (folder / "best.pt").unlink()
    with pytest.raises(InputError, match=r"no good checkpoint.*last\.pt.*last-1\.pt.*last-2\.pt"):
        newest(folder)


def test_the_last_few_are_kept_and_the_newest_is_never_missing(tmp_path, monkeypatch):
    replace, missing = os.replace, []

    def watched(source, target):
        missing.append((tmp_path / "last.pt").exists())
        replace(source, target)

    monkeypatch.setattr(os, "replace", watched)
    for keep, wanted in ((1, {"last.pt": 5}), (2, {"last.pt": 5, "last-1.pt": 4})):
        for state in STATES:
            save_checkpoint(tmp_path / "last.pt", state, keep)
        assert steps_in(tmp_path) == wanted
    for state in STATES:
        save_checkpoint(tmp_path / "last.pt", state, keep=4)
    assert steps_in(tmp_path) == {"last.pt": 5, "last-1.pt": 4, "last-2.pt": 3, "last-3.pt": 2}
    assert missing.count(False) == 1  # before the first


def full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def forbidden(*_, **__):
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def half_written(path: Path, content: bytes) -> int:
    with path.open("wb") as file:
        file.write(content[: len(content) // 2])
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


FAILING = {
    "no room for the name": (storage.tempfile, "NamedTemporaryFile", full, "No space left"),
    "no room for the contents": (Path, "write_bytes", half_written, "No space left"),
    "no room when it is flushed": (storage.os, "fsync", full, "No space left"),
    "a folder that must not be written": (storage.tempfile, "NamedTemporaryFile", forbidden, "Permission denied"),
    "no folder": (Path, "mkdir", forbidden, "Permission denied"),
}


@pytest.mark.parametrize("failing", FAILING)
def test_a_checkpoint_that_cannot_be_written_leaves_the_older_ones_intact(failing, tmp_path, monkeypatch):
    folder = tmp_path / "checkpoints"
    for state in STATES[:3]:
        save_checkpoint(folder / "last.pt", state, keep=2)
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    where, name, how, words = FAILING[failing]
    monkeypatch.setattr(where, name, how)
    with pytest.raises(StorageError, match=f"last.pt cannot be written: {words}.*untouched"):
        save_checkpoint(folder / "last.pt", STATES[3], keep=2)
    monkeypatch.undo()
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    assert newest(folder)[0]["step"] == 2


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_read_only_folder_is_named(tmp_path):
    save_checkpoint(tmp_path / "last.pt", STATES[0])
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(StorageError, match="Permission denied"):
            save_checkpoint(tmp_path / "last.pt", STATES[1])
        assert load_checkpoint(tmp_path / "last.pt")["step"] == 0
    finally:
        tmp_path.chmod(0o700)


def little_room():
    """In the child: no file may grow beyond a few thousand bytes, as on a disk with no more."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, 12_000))


@pytest.mark.nightly
def test_a_run_on_a_full_disk_stops_with_a_sentence_and_can_go_on_later(tmp_path):
    folder = tmp_path / "run"
    way = (*TINY, f"hydra.run.dir={folder}", "trainer.log_every=1000")
    completed(*way, "trainer.steps=10", cwd=tmp_path)
    before = (folder / "checkpoints" / "last.pt").read_bytes()
    assert len(before) > 12_000
    (folder / "certificate.json").unlink()
    ended = train(f"resume={folder}", "trainer.steps=40", cwd=tmp_path, before=little_room)
    assert "cannot be written" in ended.sentence
    assert (folder / "checkpoints" / "last.pt").read_bytes() == before
    completed(f"resume={folder}", cwd=tmp_path)
    assert newest(folder / "checkpoints")[0]["step"] == 40


def test_two_processes_do_not_write_one_run(tmp_path):
    folder = tmp_path / "run"
    completed(*TINY, "trainer.steps=10", f"hydra.run.dir={folder}", cwd=tmp_path)
    before = {p: p.read_bytes() for p in (folder / "checkpoints").iterdir()}
    with storage.only_writer(folder):
        ended = train(f"resume={folder}", "trainer.steps=20", cwd=tmp_path)
        assert f"{folder} is being written to by another process" in ended.sentence
        with pytest.raises(InputError, match="another process"):
            from_python("circle", resume=folder, steps=20, progress=False)
    assert {p: p.read_bytes() for p in (folder / "checkpoints").iterdir()} == before
    completed(f"resume={folder}", "trainer.steps=20", cwd=tmp_path)
    assert newest(folder / "checkpoints")[0]["step"] == 20


@pytest.mark.parametrize("name", ["last.pt", "certificate.json", "controller.safetensors", "config.yaml", "unfinished"])
def test_what_a_killed_process_left_half_written_is_removed(name, tmp_path, monkeypatch):
    def killed(path):
        monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)
        raise KeyboardInterrupt

    others = [
        tmp_path / other
        for other in (name, ".hidden.pt", f".{name}.bak", f"{name}.abcdefgh", f"{name}.part", ".mine.part")
    ]
    for other in others:
        other.touch()
    with pytest.raises(KeyboardInterrupt):
        storage.write_atomically(tmp_path / name, killed)
    monkeypatch.undo()
    assert len(list(tmp_path.iterdir())) == len(others) + 1
    storage.sweep_temporaries(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(others)


def test_files_permit_what_the_user_lets_new_files_permit(tmp_path):
    (tmp_path / "plain").touch()
    storage.write_atomically(tmp_path / "whole", lambda path: path.touch())
    assert (tmp_path / "whole").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_run_goes_on_from_the_newest_good_checkpoint_and_says_which_was_not(tmp_path):
    folder = tmp_path / "run"
    trainer = small("method=dual", "trainer.checkpoint_every=5", "trainer.keep=3", "trainer.steps=18")
    trainer.fit(Observer(), folder / "checkpoints" / "last.pt")
    (folder / "checkpoints" / "last.pt").write_bytes(b"")
    run = training_run(composed("train", [f"resume={folder}"]))
    assert run.trainer.step == 15
    (note,) = run.notes
    assert "last.pt" in note


@pytest.mark.parametrize(
    "content",
    [b"", b"[1, 2]", b"a: [", b"\xff\xfe\x00", b"x: &a [1]\ny: *a", b"trainer: {steps: ${oc.env:HOME}}", b"7"],
)
def test_a_damaged_configuration_is_refused_in_one_sentence(content, tmp_path):
    folder = tmp_path / "run"
    small("method=dual", "trainer.steps=2").fit(Observer(), folder / "checkpoints" / "last.pt")
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "config.yaml").write_bytes(content)
    with pytest.raises(InputError, match=r"config\.yaml") as refused:
        training_run(composed("train", [f"resume={folder}"]))
    assert "\n" not in str(refused.value)
