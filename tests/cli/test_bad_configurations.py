"""Generated command lines that are wrong: always one clear sentence and a status, never a traceback or a file."""

import os

import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from omegaconf import OmegaConf

from ocp_torch.cli.explain import CONFIGS
from support.scripted import entered, leaves

pytestmark = pytest.mark.usefixtures("quick_composition")
EXAMPLES = int(os.environ.get("OCP_TORCH_EXAMPLES", "200"))


GROUPS = {group.name: sorted(p.stem for p in group.glob("*.yaml")) for group in CONFIGS.iterdir() if group.is_dir()}
DEFAULTS = {"problem": "circle", "method": "pd", "model": "mlp", "optimizer": "soap", "schedule": "cosine"}
DEFAULTS |= {"stepper": "simultaneous", "averaging": "ema", "sampler": "default", "warm_start": "default"}
DEFAULTS |= {"trainer": "default", "certificate": "default"}
FIELDS = [
    f"{group}.{field}"
    for group, choice in DEFAULTS.items()
    for field in leaves(OmegaConf.to_container(OmegaConf.load(CONFIGS / group / f"{choice}.yaml")))
]
# No field takes any of these.
NEVER = st.sampled_from(
    [
        "nan",
        "-inf",
        "-3",
        "-0.5",
        "{a: 1}",
        "[]",
        "[1, x]",
        "'~'",
        "1e400",
        "../../x",
        "é",
        "'a b'",
        "${nope}",
        "${",
        "???",
    ]
    + ["x=y", "1,2", "choice(1,2)", "range(3)", "{", "]", "'", "a:b:c", "\\", "0x", "__import__('os')", "!!python/none"]
)


@st.composite
def slips(draw, word: str) -> str:
    """``word`` with one letter changed, lost, doubled or swapped."""
    k = draw(st.integers(0, len(word) - 1))
    kind = draw(st.sampled_from(["change", "lose", "double", "swap"]))
    ends = {"change": "q" + word[k + 1 :], "lose": word[k + 1 :], "double": word[k] + word[k:]}
    ends["swap"] = word[k + 1 : k + 2] + word[k] + word[k + 2 :]
    return word[:k] + ends[kind]


@st.composite
def wrong(draw) -> str:
    """One override that cannot be right."""
    kind = draw(st.sampled_from(["value", "value", "value", "value", "field", "group", "choice", "lost"]))
    if kind == "value":
        return f"{draw(st.sampled_from(FIELDS))}={draw(NEVER)}"
    if kind == "field":
        field = draw(st.sampled_from([f for f in FIELDS if f != "problem._target_"]))
        slipped = draw(slips(field).filter(lambda f: f not in FIELDS))
        return f"{slipped}=1"
    if kind == "group":
        group = draw(st.sampled_from(list(GROUPS)))
        return f"{draw(slips(group).filter(lambda g: g not in GROUPS))}={GROUPS[group][0]}"
    if kind == "choice":
        group = draw(st.sampled_from(list(GROUPS)))
        return f"{group}={draw(slips(GROUPS[group][0]).filter(lambda c: c not in GROUPS[group]))}"
    needed = ("problem._target_", "method.name", "model.name", "optimizer.name", "schedule.name", "sampler.name")
    return f"~{draw(st.sampled_from([*needed, 'trainer.steps', 'trainer.batch', 'trainer.keep', 'stepper.name']))}"


RIGHT = ["seed=3", "method=dual", "problem=torus", "optimizer=adam", "trainer.steps=10", "stepper.clip=1"]


def named(override: str) -> str:
    return override.lstrip("+~").split("=")[0]


@st.composite
def command_lines(draw) -> list[str]:
    """A wrong override among up to two right ones, none of which takes it back."""
    bad = draw(wrong())
    others = [o for o in RIGHT if named(o) != named(bad)]
    right = draw(st.lists(st.sampled_from(others), max_size=2, unique=True))
    right.insert(draw(st.integers(0, len(right))), bad)
    return right


@pytest.mark.nightly
@examples(max_examples=EXAMPLES)
@given(arguments=command_lines())
def test_a_bad_configuration_ends_in_one_sentence_and_leaves_nothing(arguments, tmp_path_factory):
    cwd = tmp_path_factory.getbasetemp() / "bad"
    cwd.mkdir(exist_ok=True)
    here = os.getcwd()
    os.chdir(cwd)
    try:
        status, out, err = entered("train", *arguments, f"hydra.run.dir={cwd / 'run'}")
    finally:
        os.chdir(here)
    assert status == 2, (arguments, out, err)
    lines = err.splitlines()
    assert len(lines) == 1, err
    assert lines[0].startswith("error: ")
    assert lines[0].endswith((".", "?")), err
    assert out == ""
    assert list(cwd.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("-m", "seed=0,1", "trainer.stepz=3"), ("trainer.stepz", "did you mean 'trainer.steps'?")),
        (("-m", "problem=circle,circel"), ("circel", "did you mean 'circle'?")),
        (("-m", "seed=0,1", "certificate.stage.stepz=3"), ("certificate.stage.stepz", "'certificate.stage.steps'")),
        (("-m", "seed=0,1", "optimiser=adam"), ("optimiser", "did you mean 'optimizer'?")),
        (("-m", "seed=0,1", "hydra/launcher=slurm"), ("hydra/launcher", "slurm")),
        (("-m", "seed=0,1", "trainer.steps=3=4"), ("trainer.steps=3=4",)),
        (("-m", "seed=0,1", "hydra.sweep.dirr=x"), ("hydra.sweep.dirr",)),
        (("trainer.steps=1,2",), ("trainer.steps=1,2",)),
    ],
)
def test_a_slip_in_a_sweep_is_told_in_one_sentence_before_anything_starts(arguments, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, out, err = entered("train", *arguments)
    assert status == 2, (out, err)
    (line,) = err.splitlines()
    assert all(word in line for word in words), line
    assert (out, list(tmp_path.iterdir())) == ("", [])


def test_what_is_right_is_let_through(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert entered("train", "seed=1", "trainer.steps=5") == (0, "begun\n", "")
    assert entered("train", "-m", "seed=0,1", "problem.discount=-1,2") == (0, "begun\n", "")
    assert entered("train", "--help")[0] == 0
