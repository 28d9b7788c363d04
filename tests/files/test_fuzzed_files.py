"""Files with bytes flipped, cut and doubled, and plain data of any form: an `InputError` or success, nothing else."""

import contextlib
import io
import json
import random
import shutil

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError
from ocp_torch.files.plain import NotPlain, json_object, looked_up, require_plain, yaml_mapping
from ocp_torch.files.reading import read_json
from ocp_torch.files.storage import load_tensors, save_tensors
from ocp_torch.problems import Circle, Kuramoto
from ocp_torch.problems.recorded.recording import read
from ocp_torch.runs.compare import compare
from ocp_torch.runs.configuration import read_configuration
from ocp_torch.runs.evaluate import settings_for
from ocp_torch.runs.report.many import save_page
from ocp_torch.runs.report.report import write_report
from ocp_torch.runs.resume import result_of
from ocp_torch.training.checkpoint import load_checkpoint
from support.strangers import make_run, seal, signed

pytestmark = [pytest.mark.usefixtures("quick_composition"), pytest.mark.nightly]

ROUNDS = 100


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = make_run(tmp_path_factory.mktemp("fuzzed") / "run", "method=dual", "trainer.steps=2", "optimizer=adam")
    x = np.random.default_rng(0).random((200, 2))
    arrays = {"x": x, "f": x[:, 0], "a": 0 * x, "B": np.broadcast_to(np.eye(2), (200, 2, 2))}
    np.savez(folder / "plain.npz", **arrays)
    np.savez_compressed(folder / "packed.npz", **arrays)
    np.save(folder / "graph.npy", 1.0 - np.eye(3))
    np.savetxt(folder / "graph.txt", 1.0 - np.eye(3))
    return folder


def mangled(content: bytes, chance: random.Random) -> bytes:
    """A few bytes changed, mostly near the ends, where headers are; or a part cut, doubled or moved."""
    data = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 5, 40))):
        reach = chance.choice((16, 64, 512, len(data)))
        at = min(chance.randrange(reach), len(data) - 1)
        at = at if chance.random() < 0.6 else len(data) - 1 - at
        way = chance.randrange(7)
        if way == 0:
            data[at] ^= 1 << chance.randrange(8)
        elif way == 1:
            data[at] = chance.choice((0, 255, 0x7F, 0x80, ord("9"), ord("$"), ord("{"), ord("-")))
        elif way == 2:
            data[at : at + 8] = chance.randbytes(8)
        elif way == 3:
            data[at : at + chance.randrange(64)] = b""
        elif way == 4:
            data[at:at] = data[at : at + chance.randrange(64)]
        elif way == 5:
            del data[at:]
        else:
            data[at:at] = chance.choice(
                (b"[", b"{", b"9" * 500, b"${", b"\x00" * 4, b"\xff" * 8, b"!!python/name:os.system")
            )
        if not data:
            break
    return bytes(data)


READERS = {
    "checkpoints/last.pt": load_checkpoint,
    "controller.safetensors": load_controller,
    ".hydra/config.yaml": read_configuration,
    "certificate.json": read_json,
    "plain.npz": read,
    "packed.npz": read,
    "graph.npy": lambda p: Kuramoto(graph=str(p)),
    "graph.txt": lambda p: Kuramoto(graph=str(p)),
}


def tried(reader, path) -> bool:
    """Whether it could be read; anything but an `InputError` of one line fails the test."""
    sentence = None
    try:
        reader(path)
    except InputError as error:
        sentence = str(error)
    assert sentence is None or sentence.isprintable()
    return sentence is None


@pytest.mark.parametrize("name", READERS)
def test_mangled_files_are_read_or_refused(name, run, tmp_path):
    chance, content = random.Random(name), (run / name).read_bytes()
    path = tmp_path / (run / name).name
    path.write_bytes(content)
    assert tried(READERS[name], path)
    outcomes = []
    for _ in range(ROUNDS):
        path.write_bytes(mangled(content, chance))
        outcomes.append(tried(READERS[name], path))
    assert not all(outcomes)


def test_mangled_contents_behind_a_right_digest_are_read_or_refused(run, tmp_path):
    chance = random.Random(1)
    content = (run / "checkpoints" / "last.pt").read_bytes().partition(b"\n")[2]
    for _ in range(ROUNDS):
        seal(tmp_path / "last.pt", mangled(content, chance))
        tried(load_checkpoint, tmp_path / "last.pt")


WORDS = st.sampled_from(
    ["", "value", "${a}", "$", "\x1b[2J", "ocp_torch.problems.Torus", "nan", "1e400", "../..", "\ud800"]
)
LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), WORDS, st.text(max_size=8), st.just(10**400), st.just(2**70)
)
PLAIN = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(WORDS | st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)


@given(PLAIN)
@settings(max_examples=100)
def test_any_plain_data_in_text_come_back_or_are_refused(data):
    for write, parse in (
        (json.dumps, json_object),
        (lambda d: yaml.safe_dump(d), lambda t: looked_up(yaml_mapping(t))),
    ):
        try:
            text = write({"a": data})
        except (ValueError, UnicodeEncodeError):  # a number too long to be written
            continue
        with contextlib.suppress(NotPlain):
            found = parse(text)
            require_plain(found)
            assert set(found) == {"a"}


@given(st.text(alphabet="[]{}:,-?!&*|>'\"%@` \n\t0159.exa~<#${}", max_size=60))
@settings(max_examples=400)
def test_any_text_of_signs_is_read_or_refused(text):
    for parse in (json_object, lambda t: looked_up(yaml_mapping(t))):
        with contextlib.suppress(NotPlain):
            require_plain(parse(text))


def places(data, path=()):
    """Where something else could stand in nested groups and lists."""
    inner = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in inner:
        yield (*path, key)
        if len(path) < 4:
            yield from places(value, (*path, key))


def put(data, path, value) -> None:
    for key in path[:-1]:
        data = data[key]
    data[path[-1]] = value


ODD = [
    None,
    True,
    -1,
    0,
    2**31,
    10**38,
    0.5,
    -1e308,
    "",
    "value",
    [],
    {},
    [[]],
    {"name": "x"},
    ["x"] * 9,
    "x" * 5000,
    [1.0] * 500,
]


def odd_places(data, chance, count):
    everywhere = list(places(data))
    return [(chance.choice(everywhere), chance.choice(ODD)) for _ in range(count)]


@pytest.mark.nightly
def test_any_field_of_a_controller_replaced_by_anything_is_taken_or_refused(run, tmp_path):
    path, chance = tmp_path / "controller.safetensors", random.Random(2)
    tensors, good = load_tensors(run / "controller.safetensors")
    x = torch.rand(3, 1)

    def used(path):
        controller = load_controller(path)
        if controller.problem.dim == 1:
            controller(x)
        settings_for(controller, {"run": path, "certificate": {}})

    for where, value in odd_places(good, chance, 200):
        metadata = json.loads(json.dumps(good))
        put(metadata, where, value)
        save_tensors(path, tensors, metadata)
        tried(used, path)


def test_any_field_of_a_certificate_replaced_by_anything_is_shown_or_named(run, tmp_path):
    chance, folder = random.Random(3), tmp_path / "run"
    folder.mkdir()
    good = json.loads((run / "certificate.json").read_text())
    for where, value in odd_places(good, chance, 200):
        certificate = json.loads(json.dumps(good))
        put(certificate, where, value)
        (folder / "certificate.json").write_text(json.dumps(certificate))
        save_page(compare([folder]), tmp_path / "runs.html")
        with contextlib.suppress(InputError):
            write_report(folder, Circle(), {})
        shown = compare([folder]).table()
        assert all(line.isprintable() for line in shown.split("\n"))
        assert all(len(line) < 800 for line in shown.split("\n"))
        result_of(folder, {"ended": True, "config": 1, "step": good["step"]}, 1)


@pytest.mark.nightly
def test_any_entry_of_a_checkpoint_replaced_by_anything_is_refused_or_goes_on(run, tmp_path):
    from ocp_torch.cli.compose import composed
    from ocp_torch.runs.run import training_run

    chance, folder = random.Random(4), tmp_path / "run"
    shutil.copytree(run, folder)
    buffer = io.BytesIO()
    torch.save(load_checkpoint(folder / "checkpoints" / "last.pt"), buffer)
    good = lambda: torch.load(io.BytesIO(buffer.getvalue()), weights_only=True)
    for where, value in odd_places(good(), chance, 40):
        state = good()
        put(state, where, value)
        signed(folder / "checkpoints" / "last.pt", state)
        tried(lambda path: training_run(composed("train", [f"resume={path}"])), folder)
