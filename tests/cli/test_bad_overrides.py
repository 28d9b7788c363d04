"""Every field of every script with what no field takes: one sentence and status 2, and never a file."""

import os
import random
import stat

import pytest

from ocp_torch.cli.compose import composed, register_resolvers
from support.scripted import CHECKED, entered, leaves
from support.small import session, small

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")
# Of each script; `OCP_TORCH_EXAMPLES` asks for more, the quick tests try a few.
MANY = int(os.environ.get("OCP_TORCH_EXAMPLES", "0"))
EXAMPLES = dict.fromkeys([*CHECKED, "compare"], max(100, MANY)) | {"train": max(200, MANY)}
FEW = 6
# No field takes any of these.
NUMBERS = [
    "9" * 400,
    "-" + "9" * 400,
    "9" * 400 + ".5",
    "9" * 5000,
    "1e300",
    "-1e300",
    "1e400",
    "nan",
    "inf",
    "-inf",
    "-3",
    "-0.5",
]
OTHERS = [
    "{a: 1}",
    "[[1, x]]",
    "[1e300, 1e300]",
    "[nan, 1]",
    "{a: {b: nan}}",
    "'\\x1b[31m'",
    "'a\\nb'",
    "é",
    "/proc/x",
    "/dev/null/x",
]
PLACES = ["/proc/x", "/dev/null/x", f"{__file__}/x", "/proc/1/x", "a/" * 2500, "b" * 300]
# What is right whatever it is: names of what is not looked for before the work begins.
FREE = {"out", "save", "animation", "video"}


@pytest.fixture(scope="module")
def bases(tmp_path_factory):
    """What each script needs to be let through."""
    place = tmp_path_factory.mktemp("bases")
    run = place / "run"
    session(small("method=dual", "trainer.steps=2", "trainer.figures=false", "certificate.points=64"), run)
    (place / "law.py").write_text("def u(x):\n    return 0.0 * x\n")
    return {
        "train": (),
        "certify": (f"controller={place}/law.py:u",),
        "evaluate": (f"run={run}",),
        "reference": ("problem=circle", "side=64"),
        "record": (f"out={place}/x.npz",),
        "rollout": (f"run={run}", "env=ocp_torch/Circle-v0"),
        "benchmark": (),
        "reproduce_paper": (),
        "compare": (str(run),),
    }


def wrong(name: str, base: tuple[str, ...], chance: random.Random) -> list[str]:
    """A command line of ``name`` with one thing that cannot be right."""
    if name == "compare":
        word = chance.choice([*NUMBERS, *OTHERS, *PLACES, "nowhere"])
        return chance.choice(
            [[word], [f"{chance.choice(['csv', 'plot', 'cvs'])}={chance.choice(PLACES)}", *base], ["csv="]]
        )
    register_resolvers()
    data = composed(name, list(base))
    fields = sorted(set(leaves(data)) - FREE)
    groups = sorted({f.rpartition(".")[0] for f in fields} - {""})
    kind = chance.choice(["value"] * 6 + ["left out", "added", "group", "place", "sweep"])
    field = chance.choice(fields)
    if kind == "value":
        bad = f"{field}={chance.choice(NUMBERS + OTHERS)}"
    elif kind == "left out":
        bad = f"~{chance.choice([f for f in fields if not f.startswith('problem.')])}"
    elif kind == "added":
        bad = f"+{chance.choice(groups)}.no_such_field=1" if groups else "no_such_field=1"
    elif kind == "group":
        bad = f"{chance.choice(groups) if groups else field}={chance.choice(NUMBERS)}"
    elif kind == "place":
        bad = f"hydra.run.dir={chance.choice(PLACES)}"
    else:
        bad = f"{field}={chance.choice(['1,2', 'choice(1,2)', 'range(3)'])}"
    return [*(word for word in base if word.split("=")[0] != bad.split("=")[0]), bad]


def assert_refused(name: str, arguments: list[str]) -> None:
    status, out, err = entered(name, *arguments)
    assert status == 2, (arguments, status, out[-300:], err[-300:])
    (line,) = err.splitlines()
    assert line.startswith("error: "), line
    assert line.endswith((".", "?")), line
    assert line.isprintable(), line
    assert len(line) < 1000, line
    assert os.listdir(".") == [], arguments


def try_all(name: str, count: int, bases, folder, monkeypatch) -> None:
    if name == "rollout":
        pytest.importorskip("gymnasium")
    monkeypatch.chdir(folder)
    chance = random.Random(name)
    for _ in range(count):
        assert_refused(name, wrong(name, bases[name], chance))


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_few_bad_overrides_of_every_script_are_one_sentence_each(name, bases, tmp_path, monkeypatch):
    try_all(name, FEW, bases, tmp_path, monkeypatch)


@pytest.mark.nightly
@pytest.mark.parametrize("name", EXAMPLES)
def test_hundreds_of_bad_overrides_of_every_script_are_one_sentence_each(name, bases, tmp_path, monkeypatch):
    try_all(name, EXAMPLES[name], bases, tmp_path, monkeypatch)


@pytest.mark.parametrize("name", EXAMPLES)
def test_what_they_are_wrong_in_is_right_without_it(name, bases, tmp_path, monkeypatch):
    if name == "rollout":
        pytest.importorskip("gymnasium")
    monkeypatch.chdir(tmp_path)
    status, _, err = entered(name, *bases[name])
    assert (status, err) == (0, "")


REFUSED = {
    ("averaging.decay=1",): "averaging.decay is 1",
    (
        "problem=manufactured",
        "problem.interaction=1000000000",
    ): "problem.interaction is 1000000000, but must be at most 2",
    ("problem=manufactured", "problem.dim=3", "certificate.rigorous=true"): "certificate.rigorous is true",
    ("method=primal", "certificate.rigorous=true"): "no V that the proof could speak of",
    ("problem=robot", "problem.tip=hand"): "problem.tip is 'hand'",
    ("problem=callable", "problem.target=sys:exit"): "asks Python to exit",
    ("problem=arm", "problem.target=[1e300,1e300]"): "problem.target[0] is 1e+300",
    ("problem=torus", "problem.dim=1024"): "problem.dim times control_dim",
    ("optimizer.lr=1e300",): "optimizer.lr is 1e+300",
    ("trainer.batch=2147483647",): "GB of memory or more",
    ("certificate.points=2147483647",): "certificate.points is 2147483647, which needs",
    ("certificate.trajectories=2147483647",): "certificate.trajectories is 2147483647, which needs",
    ("~problem",): "~problem leaves out problem",
    ("problem=[]",): "problem is missing",
    ("problem=own.py",): "is problem._target_=own.MyProblem.",
    ("problem=./own.py",): "problem is './own.py', but must be one of",
    ("problem=/home/me/own.py:Mine",): "is problem._target_=own.Mine.",
    ("problem=./configs/problem/circle.yaml",): "unicycle; write problem=circle.",
    ("problem=/home/me/circle.yml",): "unicycle; write problem=circle.",
    ("method=configs/method/dual.yaml",): "write method=dual.",
    ("problem=/home/me/circle.py:Mine",): "is problem._target_=circle.Mine.",
    ("problem=mine.yaml",): "a file of your own cannot be given, but its fields can, problem.<field>=<value>.",
    ("problem=own.Mine",): "is problem._target_=own.Mine.",
    ("problem=pendulm",): "(did you mean 'pendulum'?).",
    ("method={a: 1}",): "method is a group, not a field",
    ("+traner.steps=10",): "traner is not a field of the configuration (did you mean 'trainer'?)",
    ("--problem=circle",): "write problem=circle, without the dashes",
    ("problem._target_=ocp_torch.problems.Circl",): "has no class Circl (did you mean 'Circle'?)",
    ("problem=[circle,torus]",): "-m problem=circle,torus takes each in turn",
    ("x=1",): "x is not a field of the configuration.",
    ("-m", "seed=1,x"): "seed is 'x'",
    ("-m", "trainer.steps=1,true"): "trainer.steps is True",
    ("-m", "averaging.decay=0.5,1"): "averaging.decay is 1",
    ("-m", "seed=1,2", "hydra.sweep.dir=/dev/null"): "hydra.sweep.dir is '/dev/null'",
}


@pytest.mark.parametrize("arguments", REFUSED, ids=" ".join)
def test_what_would_fail_late_or_silently_is_refused_by_name(arguments, tmp_path, monkeypatch):
    # As on a machine of 25 GB, whatever this one has.
    monkeypatch.setattr("ocp_torch.files.limits.memory", lambda: 25e9)
    monkeypatch.chdir(tmp_path)
    assert_refused("train", list(arguments))
    assert REFUSED[arguments] in entered("train", *arguments)[2]


def test_a_folder_that_is_missing_can_still_be_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert entered("train", f"hydra.run.dir={tmp_path}/a/b/c") == (0, "begun\n", "")
    assert list(tmp_path.iterdir()) == []


def test_no_file_takes_the_place_of_what_is_none(bases, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    os.mkdir("folder")
    for place in ("pipe", "folder"):
        status, _, err = entered("compare", f"csv={place}", *bases["compare"])
        assert (status, "is no file but a folder or a device" in err) == (2, True)
    assert stat.S_ISFIFO(os.stat("pipe").st_mode)
    assert sorted(os.listdir()) == ["folder", "pipe"]
