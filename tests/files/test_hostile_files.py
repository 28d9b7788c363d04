"""Files of strangers: whatever they hold, loading, evaluating and resuming run nothing from them."""

import hashlib
import io
import json
import os
import pickle
import shutil
import struct
import zipfile

import pytest
import torch
import yaml

from ocp_torch import load_controller
from ocp_torch.cli.compose import composed
from ocp_torch.errors import InputError
from ocp_torch.files.storage import load_tensors, save_tensors
from ocp_torch.runs.finish import controller_of
from ocp_torch.runs.run import training_run
from ocp_torch.training.checkpoint import MAGIC, SCHEMA, load_checkpoint
from support.forked import command
from support.looks import certificate
from support.small import small

pytestmark = pytest.mark.usefixtures("quick_composition")

WAY = ("method=dual", "trainer.steps=3", "optimizer=adam")


class Canary:
    """Unpickled by a careless reader, it would leave a folder behind."""

    def __init__(self, path) -> None:
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.fixture(scope="module")
def stranger(tmp_path_factory):
    """A good run's folder, to be made bad."""
    from ocp_torch.training.monitor import Observer

    folder = tmp_path_factory.mktemp("stranger") / "run"
    trainer = small(*WAY)
    trainer.fit(Observer(), folder / "checkpoints" / "last.pt")
    (folder / ".hydra").mkdir()
    (folder / ".hydra" / "config.yaml").write_text(yaml.safe_dump(trainer.config))
    shown = certificate(trainer.run, 0.1, 0.2)
    controller_of(trainer, shown, "value", trainer.averaged_fields).save(folder / "controller.safetensors")
    return folder


@pytest.fixture
def run(stranger, tmp_path):
    shutil.copytree(stranger, tmp_path / "run")
    return tmp_path / "run"


def refused(folder, *overrides: str) -> str:
    """The sentence with which going on from ``folder`` is refused."""
    with pytest.raises(InputError) as error:
        training_run(composed("train", [f"resume={folder}", *overrides]))
    sentence = str(error.value)
    assert "\n" not in sentence
    return sentence


def signed(path, state) -> None:
    """A checkpoint of ``state`` whose digest is right."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    seal(path, buffer.getvalue())


def seal(path, content: bytes) -> None:
    digest = hashlib.sha256(content).hexdigest()
    path.write_bytes(f"{MAGIC} {SCHEMA} {digest}\n".encode() + content)


def put(state: dict, where: str, value) -> None:
    *groups, last = where.split("/")
    for group in groups:
        state = state[group]
    state[last] = value


SLOTS = [
    "bomb",
    "step",
    "config",
    "config/problem",
    "fields",
    "average",
    "stepper/optimizers",
    "stepper/optimizers/value/state",
    "stepper/optimizers/value/param_groups",
    "stepper/schedules/value",
    "batches/sampler/count",
    "batches/generator",
    "batches/states",
    "watch/best",
    "watch/fields",
    "generators/numpy",
]


@pytest.mark.parametrize("slot", SLOTS)
def test_a_pickle_bomb_in_any_slot_of_a_checkpoint_does_not_go_off(slot, run, tmp_path):
    path, canary = run / "checkpoints" / "last.pt", tmp_path / "canary"
    state = load_checkpoint(path)
    put(state, slot, Canary(canary))
    signed(path, state)
    assert "last.pt" in refused(run)
    assert not canary.exists()
    pickle.loads(pickle.dumps(Canary(canary)))  # it does, for a careless reader
    assert canary.exists()


def test_a_bare_pickle_is_no_checkpoint(run, tmp_path):
    path, canary = run / "checkpoints" / "last.pt", tmp_path / "canary"
    bomb = pickle.dumps(Canary(canary))
    path.write_bytes(bomb)
    refused(run)
    seal(path, bomb)
    refused(run)
    assert not canary.exists()


ABSURD = {
    "step": [-1, "3", 1.5, 10**30, None],
    "round": [-1, 10**9, "x"],
    "seconds": [float("nan"), "x", -1.0],
    "bounds": [{}, {"M": float("nan"), "warnings": []}, {"M": -1.0, "warnings": []}, 3],
    "problem": ["torus", "os.system", None],
    "method": ["pd", 3],
    "fields": [{}, {"networks.value.head.weight": torch.zeros(10**6)}, [], None],
    "average": [{}, 7],
    "batches": [{}, None],
    "batches/generator": [torch.zeros(3, dtype=torch.uint8), torch.zeros(2), "x"],
    "batches/states": [3, torch.rand(4, 9), torch.full((4, 1), float("nan"))],
    "batches/sampler": [{}, {"count": -1}, {"count": "x"}, {"count": 10**30}],
    "watch": [{}, None],
    "generators": [{}, {"torch": torch.zeros(1, dtype=torch.uint8), "numpy": [], "python": []}],
    "stepper": [{}, {"optimizers": {}, "schedules": {}}],
    "stepper/optimizers/value": [{}, {"state": {}, "param_groups": []}],
    "stepper/optimizers/value/state/0/exp_avg": [torch.zeros(10**6), torch.zeros(0), "x", None],
    "stepper/optimizers/value/param_groups/0/lr": ["x", None],
    "config": [None, 3, {}],
}
CRAFTED = [(where, k) for where, values in ABSURD.items() for k in range(len(values))]


@pytest.mark.parametrize(("where", "which"), CRAFTED, ids=lambda v: str(v))
def test_an_absurd_state_with_a_right_digest_is_refused_in_one_sentence(where, which, run):
    path = run / "checkpoints" / "last.pt"
    state = load_checkpoint(path)
    parts = where.split("/")
    target = state
    for part in parts[:-1]:
        target = target[int(part) if part.isdigit() else part]
    target[parts[-1]] = ABSURD[where][which]
    signed(path, state)
    assert refused(run)


def test_weights_that_are_not_numbers_are_refused(run):
    path = run / "checkpoints" / "last.pt"
    for group in ("fields", "average"):
        state = load_checkpoint(path)
        name = next(n for n in state[group] if n.endswith("head.weight"))
        kept = state[group][name].clone()
        state[group][name] = torch.full_like(kept, float("nan"))
        signed(path, state)
        assert "not finite" in refused(run)
        state[group][name] = kept
        signed(path, state)
        assert training_run(composed("train", [f"resume={run}"])).trainer.step == 3


def test_a_small_storage_seen_as_a_huge_tensor_is_not_believed(run):
    path = run / "checkpoints" / "last.pt"
    state = load_checkpoint(path)
    state["stepper"]["optimizers"]["value"]["state"][0]["exp_avg"] = torch.zeros(1).expand(10**11)
    signed(path, state)
    assert "not all there" in refused(run)


def test_a_compressed_archive_is_not_unpacked(run):
    path = run / "checkpoints" / "last.pt"
    content = path.read_bytes().partition(b"\n")[2]
    packed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
    seal(path, packed.getvalue())
    assert "compressed" in refused(run)


TARGETS = [
    "os.system",
    "torch.load",
    "pickle.loads",
    "my_module.Mine",
    "../evil.Mine",
    "ocp_torch.cli.launch.fail",
    "",
    None,
    3,
]


@pytest.mark.parametrize("target", TARGETS)
def test_a_problem_named_in_a_file_is_never_imported(target, run, tmp_path, monkeypatch):
    canary = tmp_path / "canary"
    (tmp_path / "my_module.py").write_text(f"import os\nos.mkdir({str(canary)!r})\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    file = run / ".hydra" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    config["problem"] = {"_target_": target, "command": f"mkdir {canary}", "f": str(canary)}
    file.write_text(yaml.safe_dump(config))
    assert "problem._target_=my_module.MyProblem" in refused(run)
    file.unlink()  # then the checkpoint's own copy counts, and is not believed either
    path = run / "checkpoints" / "last.pt"
    state = load_checkpoint(path)
    state["config"]["problem"] = config["problem"]
    signed(path, state)
    assert "problem._target_=my_module.MyProblem" in refused(run)
    assert not canary.exists()


YAMLS = [
    "!!python/object/apply:os.mkdir [{canary}]",
    "problem: !!python/object/apply:os.mkdir [{canary}]",
    "problem: {{_target_: !!python/name:os.system ''}}",
    "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]",
    "seed: ${{oc.env:HOME}}",
    "seed: ${{oc.create:${{oc.env:HOME}}}}",
    "[" * 5000,
]


@pytest.mark.parametrize("text", YAMLS, ids=lambda t: t[:30])
def test_a_crafted_configuration_file_is_read_as_data(text, run, tmp_path):
    canary = tmp_path / "canary"
    (run / ".hydra" / "config.yaml").write_text(text.format(canary=canary))
    assert "config.yaml" in refused(run)
    assert not canary.exists()


def test_paths_in_a_configuration_lead_nowhere(run, tmp_path):
    file = run / ".hydra" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    config |= {"hydra": {"run": {"dir": str(tmp_path / "elsewhere")}}, "resume": "../../elsewhere"}
    file.write_text(yaml.safe_dump(config))
    prepared = training_run(composed("train", [f"resume={run}"]))
    assert prepared.trainer.step == 3
    assert not (tmp_path / "elsewhere").exists()


def test_a_header_that_claims_ten_gigabytes_is_refused_at_once(run):
    path = run / "controller.safetensors"
    good = path.read_bytes()
    for size in (10 * 2**30, 2**63, len(good) + 1):
        path.write_bytes(struct.pack("<Q", size) + good[8:])
        with pytest.raises(InputError, match="not a readable safetensors file"):
            load_controller(path)
    path.write_bytes(b"")
    os.truncate(path, 2**34)  # a file of 16 GB, with holes
    with pytest.raises(InputError, match="bytes"):
        load_controller(path)


METADATA = {
    "problem name": {"problem": {"name": "os.system", "parameters": {"command": "mkdir {canary}"}}},
    "a target": {"problem": {"_target_": "os.system", "name": "circle", "parameters": {"_target_": "os.system"}}},
    "a target in the config": {"config": {"problem": {"_target_": "os.mkdir", "path": "{canary}"}, "certificate": 3}},
    "a path": {"problem": {"name": "../../canary", "parameters": {}}},
    "points": {"config": {"certificate": {"points": 10**12}}},
    "replicates": {"config": {"certificate": {"replicates": 10**12}}},
    "threads": {"config": {"certificate": {"stage": {}}, "trainer": {"threads": 10**9}}},
    "no certificate": {"certificate": {}},
    "certificate": {"certificate": [1]},
    "seed": {"certificate": {"seed": "os.system"}},
}


@pytest.mark.parametrize("what", METADATA)
def test_evaluate_believes_nothing_that_a_controller_file_claims(what, run, tmp_path):
    path, canary = run / "controller.safetensors", tmp_path / "canary"
    tensors, metadata = load_tensors(path)
    save_tensors(path, tensors, metadata | json.loads(json.dumps(METADATA[what]).replace("{canary}", str(canary))))
    ended = command("evaluate", f"run={run}", cwd=tmp_path)
    assert ended.sentence
    assert not canary.exists()
