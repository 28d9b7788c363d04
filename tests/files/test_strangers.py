"""Files of strangers that would take all memory, all time, or a place elsewhere: each ends in a sentence, at little cost."""

import io
import json
import logging
import os
import shutil
import struct
import zipfile

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import save_file

from ocp_torch import load_controller
from ocp_torch.certificate import table
from ocp_torch.cli.compose import composed
from ocp_torch.cli.outcome import Record
from ocp_torch.cli.single import checked
from ocp_torch.control.policies import CLOSED
from ocp_torch.errors import InputError, visible
from ocp_torch.files.arrays import read_npz
from ocp_torch.files.reading import kind, read_json
from ocp_torch.files.storage import digest, load_tensors, save_tensors
from ocp_torch.problems import Kuramoto, Torus
from ocp_torch.problems.recorded.recording import read
from ocp_torch.problems.simulator.target import resolved
from ocp_torch.problems.systems.robot import read_chain
from ocp_torch.runs import canvas
from ocp_torch.runs.compare import compare
from ocp_torch.runs.configuration import read_configuration, saved_configuration
from ocp_torch.runs.evaluate import certify_saved, load_run, settings_for
from ocp_torch.runs.figures import interval_figure
from ocp_torch.runs.loading import load_policy
from ocp_torch.runs.run import summary, training_run
from ocp_torch.studies.reference.session import ReferenceJob
from ocp_torch.training.checkpoint import load_checkpoint
from support.forked import command
from support.guarded import guarded, refusal
from support.strangers import changed, make_run, seal, signed

pytestmark = pytest.mark.usefixtures("quick_composition")

WAY = ("method=dual", "trainer.steps=3", "optimizer=adam")
HUGE, BITS = "9" * 400, 2**20_000
ESCAPE = "\x1b]0;mine\x07\x1b[2J\r\n\u202eforged: all is well"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("strange") / "run", *WAY)


@pytest.fixture
def run(made, tmp_path):
    shutil.copytree(made, tmp_path / "run")
    return tmp_path / "run"


def going_on(run, *overrides: str):
    return lambda: training_run(composed("train", [f"resume={run}", *overrides]))


# A run folder that leads elsewhere


def linked(run, name, elsewhere):
    entry = run / name
    if entry.is_dir():
        shutil.move(entry, elsewhere)
    else:
        elsewhere.write_text("mine\n")
        entry.unlink(missing_ok=True)
    entry.symlink_to(elsewhere)


def hard_linked(run, name, elsewhere):
    elsewhere.write_text("mine\n")
    (run / name).unlink()
    os.link(elsewhere, run / name)


def piped(run, name, elsewhere):
    elsewhere.write_text("mine\n")
    (run / name).unlink(missing_ok=True)
    os.mkfifo(run / name)


ENTRIES = [
    *((linked, n) for n in ("train.log", "figures", "checkpoints", ".hydra", "certificate.json", "report.html")),
    *(
        (linked, n)
        for n in ("controller.safetensors", "checkpoints/last.pt", ".hydra/config.yaml", "events.out.tfevents.1")
    ),
    (hard_linked, "train.log"),
    *((piped, n) for n in ("train.log", "certificate.json", ".hydra/config.yaml", "checkpoints/last.pt")),
]


def contents(folder):
    return (
        {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()} if folder.is_dir() else None
    )


@pytest.mark.parametrize(("how", "name"), ENTRIES, ids=lambda v: v if isinstance(v, str) else v.__name__)
def test_a_run_folder_that_leads_elsewhere_is_not_written_into(how, name, run, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    how(run, name, elsewhere)
    before = contents(elsewhere) if elsewhere.is_dir() else elsewhere.read_text()
    for arguments in ([f"resume={run}", "trainer.steps=9"], [f"hydra.run.dir={run}", *WAY]):
        sentence = refusal(lambda arguments=arguments: checked(arguments, "train", training_run))
        assert name.split("/")[0] in sentence or "resume=" in sentence
    assert (contents(elsewhere) if elsewhere.is_dir() else elsewhere.read_text()) == before


def test_the_command_leaves_the_line_that_an_attacker_wanted_elsewhere_unwritten(run, tmp_path):
    elsewhere = tmp_path / "profile"
    linked(run, "train.log", elsewhere)
    before = contents(run)
    ended = command("train", f"resume={run}", "trainer.steps=9", cwd=tmp_path)
    assert "train.log is a link" in ended.sentence
    assert elsewhere.read_text() == "mine\n"
    assert contents(run) == before


def test_a_reference_is_not_drawn_through_a_link(run, tmp_path):
    (tmp_path / "mine").mkdir()
    (run / "figures").symlink_to(tmp_path / "mine")
    config = {"run": str(run), "problem": {}, "side": None, "memory": 1.0, "threads": 1, "save": None}
    for named in (run, run / "controller.safetensors"):
        assert "link" in refusal(lambda named=named: ReferenceJob({**config, "run": str(named)}))
    (run / "figures").unlink()
    for named in (run, run.parent):  # a folder of runs stands for the newest
        assert ReferenceJob({**config, "run": str(named)}).figure == run / "figures" / "reference.png"


def test_links_of_the_users_own_are_no_matter(run, tmp_path):
    """The folder itself, and what a run does not write."""
    (run / "data").symlink_to(tmp_path)
    (tmp_path / "alias").symlink_to(run)
    assert guarded(lambda: checked([f"resume={tmp_path / 'alias'}"], "train", training_run)) is None


# What is printed


def test_what_comes_from_a_file_steers_no_terminal(run, caplog):
    certificate = json.loads((run / "certificate.json").read_text())
    bad = {**certificate, "problem": ESCAPE, "method": ESCAPE, "warnings": [ESCAPE]}
    bad |= {"perf_lower": {ESCAPE: certificate["perf"]["value"]}}
    shown = table(bad)
    assert len(shown.splitlines()) == len(
        table({**bad, **{k: certificate[k] for k in ("problem", "method")}}).splitlines()
    )
    assert all(line.isprintable() for line in shown.split("\n"))
    assert r"\x1b]0;mine\x07" in shown
    assert str(InputError(ESCAPE)) == visible(ESCAPE)
    assert str(InputError(ESCAPE)).isprintable()
    record = Record("a", logging.INFO, "f", 1, "saved in %s\nnext", (ESCAPE,), None)
    assert record.getMessage().splitlines()[-1] == "next"
    assert "\x1b" not in record.getMessage()
    assert "\u202e" not in record.getMessage()


def test_a_name_in_a_figure_is_no_formula(run, tmp_path):
    certificate = json.loads((run / "certificate.json").read_text())
    for name in ("$\\nothing{", "$x$", ESCAPE, "x" * 10**5):
        figure = interval_figure({**certificate, "problem": name})
        canvas.save(canvas.drawn({"certificate": figure}), tmp_path)
        assert figure.axes[0].get_title().startswith(visible(name)[:20])
    (tmp_path / "runs" / "$\\bad{").mkdir(parents=True)
    (tmp_path / "runs" / "$\\bad{" / "certificate.json").write_text(json.dumps(certificate))
    compare([tmp_path / "runs"]).save_plot(tmp_path / "runs.png")


@pytest.mark.nightly
def test_notes_of_a_checkpoint_and_of_a_controller_are_printed_escaped(run):
    path = run / "checkpoints" / "last.pt"
    changed(path, "bounds/warnings", [ESCAPE])
    changed(path, "watch/notes", [ESCAPE])
    trainer = going_on(run)().trainer
    assert all(line.isprintable() for line in summary(trainer).split("\n"))
    assert trainer.health.notes == [visible(ESCAPE)]
    changed(path, "watch/notes", [ESCAPE] * 10**5)
    assert "sentences" in refusal(going_on(run))
    remade(run, lambda m: m["bounds"].update(warnings=[ESCAPE]))
    assert load_controller(run / "controller.safetensors").constants.warnings == (visible(ESCAPE),)


def test_a_problem_name_of_a_controller_is_printed_escaped(run, monkeypatch):
    remade(run, lambda m: m["certificate"].update(problem=ESCAPE, method=ESCAPE))
    said = []
    monkeypatch.setattr("ocp_torch.runs.evaluate.log.info", lambda text, *a: said.append(text % a))
    controller = load_controller(run / "controller.safetensors")
    small = {
        "points": 64,
        "replicates": 2,
        "trajectories": 0,
        "ascents": 1,
        "occupation_states": 0,
        "stage": {"steps": 0},
    }
    certificate = certify_saved(controller, settings_for(controller, {"run": run, "certificate": small}))
    assert certificate.run.problem.isprintable()
    assert all(line.isprintable() for line in "".join(said).split("\n"))


# Configurations

YAMLS = {
    "a hidden dollar": r'seed: "\x24{oc.env:HOME}"',
    "a hidden colon": r'seed: "${oc.env\x3aHOME}"',
    "nested": "a: oc.env:HOME\nseed: ${${a}}",
    "in an extra key": 'extra: {deep: ["\\x24{oc.env:HOME}"]}',
    "in a key": "'${oc.env:HOME}': 1",
    "quadratic": "a: '" + "${" * 4000 + "'",
    "exponential": "a0: x\n" + "".join(f"a{k}: ${{a{k - 1}}}${{a{k - 1}}}\n" for k in range(1, 60)),
    "a circle": "a: ${b}\nb: ${a}",
    "a group": "a: {b: 1}\nc: ${a}",
    "binary": "seed: !!binary AAAA",
    "a set": "seed: !!set {a}",
    "a word by its tag": "seed: !!str 3",
    "a date": "seed: 2026-01-01",
    "aliases": "a: &a [x, x]\nb: [*a, *a]",
    "merged": "a: &a {x: 1}\nb: {<<: *a}",
    "400 digits": f"seed: {HUGE}",
    "20,000 bits": f"seed: 0x{'f' * 5000}",
    "octal bits": f"seed: 0{'7' * 5000}",
    "base sixty": "seed: 1" + ":59" * 2000,
    "base sixty, a megabyte": "seed: 1" + ":59" * 300_000,
    "a long word": "seed: " + "x" * 900_000,
    "deep lists": "seed: " + "[" * 400_000,
    "deep dashes": "- " * 400_000,
    "deep groups": "seed: " + "{a: " * 200_000,
    "many lists": "seed: [" + "[]," * 300_000 + "]",
    "many keys": "\n".join(f"k{k}: 1" for k in range(80_000)),
    "many anchors": "seed: [" + ",".join(f"&a{k} 1" for k in range(40_000)) + "]",
    "control characters": "seed: \x00\x1b[2J",
    "no text": "\ud800",
    "a list": "[1, 2]",
    "a name that is a list": "{[1]: 2}",
}
# What is large but plain is read, and refused, if at all, for what it says.
HARMLESS = {"many anchors"}


@pytest.mark.nightly
@pytest.mark.parametrize("what", YAMLS)
def test_a_crafted_configuration_costs_little(what, run):
    file = run / ".hydra" / "config.yaml"
    file.write_bytes(YAMLS[what].encode(errors="surrogatepass"))
    sentence = guarded(lambda: read_configuration(file))
    assert (sentence is None) == (what in HARMLESS), sentence
    if sentence is not None:
        assert "config.yaml" in refusal(going_on(run))


def test_a_plain_reference_is_looked_up(run):
    file = run / ".hydra" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    text = yaml.safe_dump({**config, "seed": "${trainer.keep}", "extra": "${seed}"})
    file.write_text(text)
    found = read_configuration(file)
    assert (found["seed"], found["extra"]) == (config["trainer"]["keep"],) * 2


SIZES = {
    "dimension": ("problem", {"_target_": "ocp_torch.problems.Manufactured", "dim": 1024}),
    "adjacency": ("problem", {"_target_": "ocp_torch.problems.Kuramoto", "graph": [[0.0] * 300] * 3}),
    "batch": ("trainer", {"batch": 2**30}),
    "threads": ("trainer", {"threads": 1024}),
    "points": ("certificate", {"points": 2**22}),
    "rounds": ("certificate", {"stage": {"rounds": 16}}),
    "tolerance": ("certificate", {"tolerance": 1e-300}),
    "width": ("model", {"width": 2**14, "depth": 64}),
    "waves": ("model", {"waves": 4096, "modes": 1024}),
}


@pytest.mark.parametrize("what", SIZES)
def test_a_configuration_that_asks_for_the_machine_is_refused(what, run):
    file, (section, change) = run / ".hydra" / "config.yaml", SIZES[what]
    config = yaml.safe_load(file.read_text())
    config[section] = change if section == "problem" else {**config[section], **change}
    file.write_text(yaml.safe_dump(config))
    assert refusal(going_on(run))


def test_what_a_file_may_not_ask_for_the_user_may(run):
    file = run / ".hydra" / "config.yaml"
    config = yaml.safe_load(file.read_text())
    config["certificate"]["points"] = 2**20
    file.write_text(yaml.safe_dump(config))
    assert "certificate.points=1048576 yourself" in refusal(going_on(run))
    assert guarded(going_on(run, "certificate.points=1048576")) is None


# Checkpoints


def shared(depth: int = 45):
    inner = []
    for _ in range(depth):
        inner = [inner, inner]
    return inner


def nested(depth: int):
    inner = []
    for _ in range(depth):
        inner = [inner]
    return inner


WEIGHTS = "fields/networks.value.head.weight"
STATES = {
    "shared lists": ("batches/states", shared()),
    "shared lists, shallow": ("watch/notes", [[[["x"] * 150] * 150] * 150]),
    "deep lists": ("batches/states", nested(100)),
    "20,000 bits": ("step", BITS),
    "20,000 bits in the notes": ("watch/notes", [BITS]),
    "bytes": ("batches/states", bytearray(10**6)),
    "a set": ("watch/notes", {"x"}),
    "complex weights": (WEIGHTS, lambda t: t.to(torch.complex64)),
    "whole weights": (WEIGHTS, lambda t: t.to(torch.int64)),
    "half weights": (WEIGHTS, lambda t: t.half()),
    "flags for weights": (WEIGHTS, lambda t: t > 0),
    "complex moments": ("stepper/optimizers/value/state/0/exp_avg", lambda t: t.to(torch.complex64)),
    "sparse weights": (WEIGHTS, lambda t: t.to_sparse()),
    "one storage seen often": ("batches/states", [torch.zeros(10**6).view(-1) for _ in range(1)] * 1000),
    "best weights of another network": ("watch/fields", {"x": torch.zeros(3)}),
    "meta weights": (WEIGHTS, lambda t: t.to("meta")),
}


@pytest.mark.nightly
@pytest.mark.parametrize("what", STATES)
def test_a_crafted_checkpoint_costs_little(what, run):
    where, value = STATES[what]
    changed(run / "checkpoints" / "last.pt", where, value)
    assert refusal(going_on(run))


def test_a_list_in_itself_is_refused(run):
    circle = []
    circle.append(circle)
    signed(run / "checkpoints" / "last.pt", {"config": circle})
    assert "deeper" in refusal(lambda: load_checkpoint(run / "checkpoints" / "last.pt"))


def test_the_refusal_of_a_pickle_does_not_say_how_to_run_it(run):
    path = run / "checkpoints" / "last.pt"
    for bad in (os.system, np.float64(3.0), run):
        signed(path, {"step": bad})
        sentence = refusal(lambda: load_checkpoint(path)).lower()
        for word in ("weights_only", "trust", "option", "safe_globals", "false"):
            assert word not in sentence, sentence
        assert "never run" in sentence


PICKLES = {
    "an allocation": b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\x00\x00\x00\x01\x85R.",
    "an allocation, by its old name": b"\x80\x02c__builtin__\nbytearray\n\x8a\x05\x00\x00\x00\x00\x01\x85R.",
    "a tensor made anew": b"\x80\x02ctorch\nFloatTensor\n\x8a\x05\x00\x00\x00\x00\x01\x85R.",
    "a name from the stack": b"\x80\x04\x8c\x02os\x8c\x06system\x93.",
    "millions of lists": b"\x80\x02(" + b"]" * 4_000_000 + b"l.",
    "more": b"\x80\x02(" + b"]" * 30_000_000 + b"l.",
    "a million groups": b"\x80\x02(" + b"}K\x01K\x01s" * 500_000 + b"l.",
    "a long number": b"\x80\x02\x8b\x00\x00\x10\x00" + b"\x7f" * 2**20 + b".",
    "deep": b"\x80\x02" + b"(" * 500_000 + b"l" * 500_000 + b".",
}


# That the name may be in capitals does not depend on what is there.
CAPITALS = [pytest.param(w, "DATA.PKL", marks=[] if w == "an allocation" else pytest.mark.nightly) for w in PICKLES]


@pytest.mark.nightly
@pytest.mark.parametrize(("what", "name"), [*((w, "data.pkl") for w in PICKLES), *CAPITALS])
def test_a_crafted_list_of_parts_makes_little(what, name, run):
    path, packed = run / "checkpoints" / "last.pt", io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr(f"archive/{name}", PICKLES[what])
        for part, text in (("version", b"3\n"), ("byteorder", b"little"), (".format_version", b"1")):
            archive.writestr(f"archive/{part}", text)
    seal(path, packed.getvalue())
    assert "not a readable checkpoint" in refusal(lambda: load_checkpoint(path))


def test_a_checkpoint_of_a_million_parts_is_not_listed(run):
    path, packed = run / "checkpoints" / "last.pt", io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("archive/data.pkl", b"")
    head = packed.getvalue()
    cut = head.index(b"PK\x01\x02")
    entry = head[cut : head.index(b"PK\x05\x06")]
    listed = entry * 300_000
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0xFFFF, 0xFFFF, len(listed), cut, 0)
    seal(path, head[:cut] + listed + end)
    assert "too many parts" in refusal(lambda: load_checkpoint(path), megabytes=150)


def test_a_huge_file_behind_a_wrong_first_line_is_not_read(run):
    path = run / "checkpoints" / "last.pt"
    for start in (b"", b"x" * 1000, b"ocp_torch-checkpoint 2 " + b"0" * 2**20):
        path.write_bytes(start)
        os.truncate(path, 2**31 - 1)
        assert "first bytes" in refusal(lambda: load_checkpoint(path), megabytes=50, seconds=5)


# Controllers


def remade(run, change):
    """The controller with its metadata changed, and its digest right."""
    path = run / "controller.safetensors"
    tensors, metadata = load_tensors(path)
    change(metadata)
    save_tensors(path, tensors, metadata)


def rewritten(path, tensors, text):
    """A controller of any metadata text."""
    save_file(tensors, str(path), metadata={"ocp_torch": text, "sha256": digest(tensors, text)})


METADATA = {
    "dimension": lambda m: m.update(problem={"name": "manufactured", "parameters": {"dim": 1024}}),
    "oscillators": lambda m: m.update(problem={"name": "kuramoto", "parameters": {"oscillators": 1024}}),
    "obstacles": lambda m: m.update(problem={"name": "arm", "parameters": {"obstacles": [[0.1, 0.1, 0.1]] * 10**5}}),
    "a million fields": lambda m: m.update(fields=[f"f{k}" for k in range(10**6)]),
    "the same field often": lambda m: m.update(fields=["value"] * 10**6),
    "fields by name": lambda m: m.update(fields="value"),
    "width": lambda m: m["model"].update(width=2**14, depth=64),
    "waves": lambda m: m["model"].update(waves=4096, modes=1024),
    "M": lambda m: m["bounds"].update(M=10**100),
    "a deep list": lambda m: m.update(extra=nested(100)),
    "a million warnings": lambda m: m["bounds"].update(warnings=["x"] * 10**6),
    "warnings in one word": lambda m: m["bounds"].update(warnings="x" * 10**6),
    "400 digits": lambda m: m.update(schema=int(HUGE)),
    "400 digits of a seed": lambda m: m["certificate"].update(seed=int(HUGE)),
    "400 digits of a discount": lambda m: m["problem"]["parameters"].update(discount=int(HUGE)),
    "a kind": lambda m: m.update(kind=["value"]),
    "a model": lambda m: m.update(model=[["name", "mlp"]]),
    "no config": lambda m: m.update(config=[]),
    "groups that are none": lambda m: m.update(config={"certificate": 3}),
}


@pytest.mark.nightly
@pytest.mark.parametrize("what", METADATA)
def test_a_crafted_controller_costs_little(what, run):
    remade(run, METADATA[what])
    assert refusal(lambda: load_controller(run / "controller.safetensors"))


TEXTS = {
    "20,000 bits": '{"schema": ' + "9" * 6020 + "}",
    "a long fraction": '{"schema": 0.' + "1" * 400 + "}",
    "infinity": '{"schema": 1e999}',
    "NaN": '{"schema": NaN}',
    "deep": "[" * 10**6,
    "deep groups": '{"a":' * 10**5,
    "many values": "[" + "[]," * 5_000_000 + "[]]",
    "a list": "[1]",
    "nothing": "",
}


@pytest.mark.parametrize("what", TEXTS)
def test_crafted_metadata_cost_little(what, run):
    path = run / "controller.safetensors"
    rewritten(path, load_tensors(path)[0], TEXTS[what])
    assert "damaged" in refusal(lambda: load_controller(path))
    (run / "certificate.json").write_text(TEXTS[what])
    assert "certificate.json" in refusal(lambda: read_json(run / "certificate.json"))
    assert refusal(lambda: (_ for _ in ()).throw(InputError(compare([run]).unfinished["run"])))


@pytest.mark.parametrize("dtype", [torch.complex64, torch.int64, torch.bool, torch.float16, torch.float64, torch.uint8])
def test_weights_of_another_type_are_refused(dtype, run):
    path = run / "controller.safetensors"
    tensors, metadata = load_tensors(path)
    save_tensors(path, {name: t.to(dtype) for name, t in tensors.items()}, metadata)
    assert str(dtype).removeprefix("torch.") in refusal(lambda: load_controller(path)).lower()


EFFORT = {
    "points": {"points": 2**22},
    "replicates": {"replicates": 10**6},
    "steps": {"stage": {"steps": 10**7}},
    "rounds": {"stage": {"rounds": 16}},
    "400 digits": {"points": 10**38},
    "tolerance": {"tolerance": 1e-300},
}


@pytest.mark.parametrize("what", EFFORT)
def test_evaluate_spends_no_more_than_a_run_would_have(what, run):
    remade(run, lambda m: m["config"]["certificate"].update(EFFORT[what]))
    config = {"run": str(run), "problem": {}, "certificate": {}}
    assert "yourself" in refusal(lambda: settings_for(load_run(config), config))
    named = {k: 2 if k != "tolerance" else 0.1 for k in EFFORT[what] if k != "stage"}
    if named:
        assert guarded(lambda: settings_for(load_run(config), {**config, "certificate": named})) is None


SAID = [
    ("problem", None),
    ("problem", 3),
    ("method", [1]),
    ("seed", "x"),
    ("step", -1),
    ("step", 1.5),
    ("train_seconds", "x"),
]


@pytest.mark.parametrize(("name", "value"), SAID)
def test_an_absurd_account_of_the_run_is_refused(name, value, run):
    remade(run, lambda m: m["certificate"].update({name: value}))
    config = {"run": str(run), "problem": {}, "certificate": {"points": 64, "replicates": 2, "trajectories": 0}}
    assert refusal(lambda: certify_saved(load_run(config), settings_for(load_run(config), config)))


# NumPy's files


def npy(descr="'<f8'", shape="(4, 4)", body=b"", version=1, length=None) -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    size = {1: "<H", 2: "<I"}[version]
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack(size, len(text) if length is None else length) + text + body


ARRAYS = {
    "a shape of 10**15": npy(shape="(1000000000000000,)"),
    "a shape of 400 digits": npy(shape=f"({HUGE},)"),
    "a negative shape": npy(shape="(-4, 4)"),
    "a header of four gigabytes": npy(version=2, length=2**32 - 1) + bytes(2**20),
    "a nested header": npy(shape="(" * 60_000),
    "a shorter nested header": npy(shape="(" * 500),
    "a header of signs": npy(shape="-" * 800 + "1"),
    "a nested type": npy(descr="[('a', " * 100 + "'<f8'" + ")]" * 100),
    "a huge type": npy(descr="'|V2000000000'"),
    "huge words": npy(descr="'<U500000000'"),
    "objects": npy(descr="'|O'"),
    "complex": npy(descr="'<c16'", body=bytes(256)),
    "less than it says": npy(body=bytes(10)),
    "no header": b"\x93NUMPY",
    "version 9": b"\x93NUMPY\x09\x00" + bytes(100),
    "nothing": b"",
}


@pytest.mark.parametrize("packed", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED], ids=["stored", "deflated"])
@pytest.mark.parametrize("what", ARRAYS)
def test_an_array_that_is_not_what_it_says_is_refused(what, packed, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", packed) as archive:
        archive.writestr("x.npy", ARRAYS[what])
    assert "a.npz" in refusal(lambda: read(tmp_path / "a.npz"))
    (tmp_path / "a.npy").write_bytes(ARRAYS[what])
    assert "a.npy" in refusal(lambda: Kuramoto(oscillators=4, graph=str(tmp_path / "a.npy")))


def streamed(path, dtype, count):
    """An array of zeros as large as may be, without the memory for it."""
    packed = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with packed as archive, archive.open("x.npy", "w", force_zip64=True) as file:
        np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": (count, 1)})
        size = np.dtype(dtype).itemsize * count
        for _ in range(size // 2**22):
            file.write(bytes(2**22))


@pytest.mark.parametrize("dtype", ["|u1", "<f2", "<f8"])
def test_what_grows_when_it_is_unpacked_is_not_unpacked(dtype, tmp_path):
    path = tmp_path / "a.npz"
    streamed(path, dtype, 2**28 // np.dtype(dtype).itemsize)
    assert path.stat().st_size < 2**21
    assert "unpacks to" in refusal(lambda: read(path), seconds=5, megabytes=50)


def test_a_way_of_packing_that_numpy_does_not_use_is_refused(tmp_path):
    for packed in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(tmp_path / "a.npz", "w", packed) as archive:
            archive.writestr("x.npy", npy(body=bytes(128)))
        assert "packed" in refusal(lambda: read(tmp_path / "a.npz"))


def test_names_twice_and_names_unknown_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", npy(body=bytes(128)))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("x.npy", npy(body=bytes(128)))
    assert "'x'" in refusal(lambda: read(path))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{ESCAPE}.npy", npy(body=bytes(128)))
    assert "no array of a recording" in refusal(lambda: read(path))


def test_constant_parts_of_a_recording_are_no_bomb(tmp_path):
    """`B` and `div_a` that hardly take any room are what records of simple problems hold."""
    count, d = 40_000, 6
    x = np.random.default_rng(0).random((count, d))
    B = np.broadcast_to(np.eye(d), (count, d, d))
    np.savez_compressed(tmp_path / "a.npz", x=x, f=x[:, 0], a=np.zeros_like(x), B=B, div_a=np.zeros(count))
    found = read_npz(tmp_path / "a.npz", ("x", "f", "a", "B", "div_a"), 2**33)
    assert (found["x"] == x).all()
    assert (found["B"] == B).all()


def test_a_graph_of_flags_is_read_as_before(tmp_path):
    np.save(tmp_path / "a.npy", ~np.eye(3, dtype=bool))
    assert Kuramoto(oscillators=3, graph=str(tmp_path / "a.npy")).graph == (1.0 - np.eye(3)).tolist()


def test_a_header_of_very_many_tensors_is_not_believed(run):
    path = run / "controller.safetensors"
    many = {f"t{k}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for k in range(60_000)}
    header = json.dumps(many).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header)
    assert "60,000 tensors" in refusal(lambda: load_controller(path))
    path.write_bytes(struct.pack("<Q", 2**24 + 1) + bytes(2**10))
    assert "header" in refusal(lambda: load_controller(path), megabytes=50)


def test_text_for_a_graph_is_no_larger_than_the_graph(tmp_path):
    (tmp_path / "a.txt").write_text("1 " * 10**7)
    assert "bytes" in refusal(lambda: Kuramoto(oscillators=4, graph=str(tmp_path / "a.txt")), megabytes=50)


# Pipes, devices and impossible paths

READERS = {
    "controller": ("controller.safetensors", load_controller),
    "checkpoint": ("last.pt", load_checkpoint),
    "resume": ("last.pt", lambda p: training_run(composed("train", [f"resume={p}"]))),
    "configuration": ("config.yaml", read_configuration),
    "certificate": ("certificate.json", read_json),
    "samples": ("data.npz", read),
    "samples in safetensors": ("data.safetensors", read),
    "a graph": ("graph.npy", lambda p: Kuramoto(graph=str(p))),
    "a graph in text": ("graph.txt", lambda p: Kuramoto(graph=str(p))),
    "a robot": ("robot.urdf", lambda p: read_chain(p, None)),
    "a function": ("mine.py", lambda p: load_policy(f"{p}:u", Torus())),
    "a target": ("mine.py", lambda p: resolved(f"{p}:u")),
    "ONNX": ("mine.onnx", lambda p: load_policy(str(p), Torus())),
    "TorchScript": ("mine.pt", lambda p: load_policy(str(p), Torus())),
    "a run": ("controller.safetensors", lambda p: load_run({"run": str(p), "problem": {}})),
    "what is compared": ("runs", lambda p: compare([p])),
}


@pytest.mark.parametrize("what", READERS)
def test_pipes_devices_and_folders_are_no_files(what, tmp_path):
    name, reader = READERS[what]
    path = tmp_path / name
    os.mkfifo(path)
    assert "pipe" in refusal(lambda: reader(path), seconds=5) or what == "what is compared"
    path.unlink()
    path.symlink_to("/dev/zero")
    assert refusal(lambda: reader(path), seconds=5)
    if "run" not in name and what not in ("a run", "resume", "what is compared"):
        path.unlink()
        path.mkdir()
        assert refusal(lambda: reader(path))


@pytest.mark.parametrize("what", READERS)
def test_a_path_beyond_all_measure_is_told_in_one_sentence(what, tmp_path):
    name, reader = READERS[what]
    for folder in ("x" * 5000, "/".join(["x" * 100] * 50), "a\x00b"):
        sentence = refusal(lambda folder=folder: reader(tmp_path / folder / name))
        assert len(sentence) < 500
    (tmp_path / "circle").symlink_to("circle")
    assert refusal(lambda: reader(tmp_path / "circle" / name))


@pytest.mark.parametrize(
    ("script", "arguments"),
    [
        ("train", "resume={}"),
        ("evaluate", "run={}"),
        ("reference", "run={}"),
        ("compare", "{}"),
        ("certify", "controller={}"),
        ("train", "problem=dataset problem.path={}.npz"),
        ("rollout", "env=ocp_torch/Circle-v0 run={}"),
    ],
)
def test_each_script_says_so(script, arguments, tmp_path):
    for path in ("x" * 5000, "/dev/zero"):
        ended = command(script, *arguments.format(path).split(), cwd=tmp_path)
        assert len(ended.sentence) < 600
        assert ended.status == 2
        assert list(tmp_path.iterdir()) == []


def test_torchscript_is_called_code(tmp_path, caplog):
    torch.jit.script(torch.nn.Linear(2, 2)).save(str(tmp_path / "mine.pt"))
    with caplog.at_level(logging.WARNING):
        load_policy(str(tmp_path / "mine.pt"), Torus())
        load_policy(str(tmp_path / "mine.pt"), Torus())
    assert caplog.text.count("code that can write your files") == 1
    assert kind(tmp_path / "mine.pt") == "file"


def test_what_the_present_version_writes_is_read(run):
    assert load_controller(run / "controller.safetensors").occupation in (None, CLOSED)
    assert going_on(run)().trainer.step == 3
    assert saved_configuration(run)["seed"] == 0
