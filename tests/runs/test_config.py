"""Every choice in configs/ builds a trainer; every wrong value is refused in one sentence that names the field."""

import pytest
import torch
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from omegaconf import OmegaConf

from ocp_torch.cli.explain import CONFIGS, known_fields
from ocp_torch.problems import Circle
from ocp_torch.runs.build import build_trainer
from ocp_torch.runs.record import record
from ocp_torch.training.trainer import Trainer
from support.small import configured, outcome

pytestmark = pytest.mark.usefixtures("quick_composition")


# What a choice needs beside itself: nothing stands for a user's own file or function.
NEEDS = {
    "problem=dataset": ("problem.path={recording}",),
    "problem=callable": ("problem.target=support.composing:oracle",),
}
CHOICES = sorted(f"{path.parent.name}={path.stem}" for path in CONFIGS.glob("*/*.yaml"))


@pytest.mark.nightly
@pytest.mark.parametrize("choice", CHOICES)
def test_every_choice_of_every_group_composes_and_builds_a_trainer(choice, tmp_path, monkeypatch):
    monkeypatch.setattr("ocp_torch.fields.waves.MOST_SUMS", 10_000)  # which waves a network is given is no part of this
    group, name = choice.split("=")
    file = tmp_path / "recording.npz"
    if choice == "problem=dataset":
        record(Circle(), 200, file, seed=0, divergences=True, contrast=0.0)
    config = configured(choice, *(need.format(recording=file) for need in NEEDS.get(choice, ())))
    assert isinstance(build_trainer(config), Trainer)
    assert config.get(group, {}).get("name", name) in (name, None)  # null: chosen by what the problem is


def test_there_is_at_least_one_choice_in_every_group():
    assert {choice.split("=")[0] for choice in CHOICES} == {path.name for path in CONFIGS.iterdir() if path.is_dir()}


def test_values_reach_what_they_name():
    trainer = outcome(
        "problem=torus",
        "problem.dim=3",
        "method=primal",
        "method.value_bound=0.3",
        "optimizer=sgd",
        "+optimizer.player_lr.density=0.25",
        "stepper=extragradient",
        "stepper.radius=5",
        "sampler=sobol",
        "trainer.dtype=float64",
        "seed=7",
    )
    assert trainer.problem.dim == 3
    assert trainer.constants.C_V == 0.3
    assert trainer.stepper.learning_rates() == {"density": 0.25}
    assert trainer.stepper.radius == 5
    assert trainer.batches.sampler.draw(2).dtype == torch.float64
    assert next(trainer.fields.parameters()).dtype == torch.float64
    assert trainer.run.seed == 7


WRONG = [
    *(f"trainer.steps={value}" for value in ("abc", "-1", "0", "true", "1.5", "[3]", "{a: 1}")),
    "trainer.batch=0",
    "trainer.threads=0",
    "trainer.log_every=0",
    "trainer.evaluate_every=-1",
    "trainer.checkpoint_every=1.0",
    "trainer.dtype=float16",
    "trainer.device=tpu",
    "trainer.figures=perhaps",
    "trainer.graphs=2",
    "trainer.progress=3",
    *(f"problem.discount={value}" for value in ("-1", "0", "nan", "inf", "abc", "null")),
    *(f"problem=manufactured problem.exponent={value}" for value in ("3", "1", "abc", "true")),
    "problem=manufactured problem.control_dim=5",
    "problem=manufactured problem.control_size=0",
    "problem=manufactured problem.contrast=1",
    "problem=manufactured problem.initial_contrast=-0.1",
    "problem=manufactured problem.state_dependent_control=2",
    "problem=manufactured problem.interaction=0",
    "problem=manufactured problem.drift=-0.5",
    "problem=manufactured problem.seed=-1",
    "problem=torus problem.dim=0",
    "problem=torus problem.dim=two",
    "problem=torus problem.shear=foo",
    "problem=torus problem.seed=0.5",
    "problem=torus problem._target_=torch.load",
    "problem=torus problem._target_=circle",
    "problem=torus problem._target_=no_such_module.Problem",
    "problem=torus +problem.colour=3",
    "model.name=resnet",
    "model.activation=relu",
    "model.width=0",
    "model.depth=-2",
    "model.modes=0",
    "+model.heads=4",
    "+model.scale=2",
    "method.name=dueling",
    "method.occupation_bound=-2",
    "method.value_bound=0",
    "method.control_bound=abc",
    "method.augmentation=-1",
    "problem=manufactured method=primal method.occupation=closed",
    "method=primal method.occupation=maybe",
    "optimizer.name=adamw",
    "optimizer.lr=-1",
    "optimizer.lr=abc",
    "stepper.clip=-1",
    "optimizer.betas=[0.9]",
    "optimizer.betas=0.9",
    "optimizer.betas=[0.9, 1.5]",
    "optimizer.betas=[1, 1]",
    "optimizer.precondition_frequency=0",
    "+optimizer.nesterov=true",
    "optimizer=sgd optimizer.momentum=-1",
    "optimizer.player_lr=3",
    "schedule.name=linear",
    "schedule=decay schedule.decay=0",
    "schedule=decay schedule.every=0",
    "stepper.name=newton",
    "stepper.radius=-1",
    "stepper.clip=0",
    "averaging.kind=median",
    "averaging.decay=2",
    "sampler.name=halton",
    "sampler=importance sampler.uniform=0",
    "sampler=importance sampler.uniform=1.1",
    "sampler=importance sampler.every=0",
    "sampler=importance sampler.pool=none",
    "sampler=sobol +sampler.pool=100",
    "certificate.points=0",
    "certificate.replicates=1",
    "certificate.trajectories=-1",
    "certificate.ascents=0",
    "certificate.mollify=maybe",
    "certificate.stage=3",
    "certificate.stage.steps=-1",
    "certificate.stage.lr=0",
    "seed=-1",
    "seed=abc",
    "problem.discount=1e300",
    "problem=torus problem.shear=random problem.seed=100000000000000000000",
    "model=null",
    "~model",
    "~optimizer.name",
    "~schedule.name",
    "~trainer.batch",
]


@pytest.mark.parametrize("overrides", WRONG)
def test_a_wrong_value_is_refused_in_one_sentence_that_names_the_field(overrides):
    parts = overrides.replace(", ", ",").replace(": ", ":").split()
    sentence = outcome(*parts)
    assert isinstance(sentence, str), "accepted"
    assert_one_sentence(sentence)
    field, _, value = parts[-1].lstrip("+~").partition("=")
    assert field in sentence
    if value.isalpha() and value not in ("true", "null", "nan", "inf"):
        assert value in sentence


def assert_one_sentence(sentence: str):
    assert sentence.strip() == sentence != ""
    assert "\n" not in sentence
    assert sentence.endswith((".", "?"))
    assert "Traceback" not in sentence


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("problem=circel", ("problem", "circel", "did you mean 'circle'?")),
        ("trainer.stepz=3", ("trainer.stepz", "did you mean 'trainer.steps'?")),
        ("problem=kuramoto problem.dim=6", ("problem.dim", "problem has", "oscillators")),
        ("problem=kuramoto problem.oscilators=6", ("problem.oscilators", "did you mean 'problem.oscillators'?")),
        ("trainr.steps=3", ("trainr.steps", "did you mean 'trainer.steps'?")),
        ("averaging.kind=unifrom", ("averaging.kind", "did you mean 'uniform'?")),
        ("+problem.discuont=3", ("problem.discuont", "did you mean 'discount'?")),
        ("+optimizer.player_lr.valeu=1.0e-3", ("optimizer.player_lr", "valeu", "did you mean 'value'?")),
        ("+optimizer.player_lr.value=-1", ("optimizer", "lr", "-1")),
        ("seed=???", ("seed is missing",)),
        ("sampler.name=???", ("sampler.name is missing",)),
        ("trainer.steps=3=4", ("trainer.steps=3=4",)),
        ("trainer.steps=4,5", ("trainer.steps=4,5",)),
        ("trainer.steps=${nowhere}", ("nowhere",)),
    ],
)
def test_a_slip_is_explained_with_what_would_be_right(override, words):
    sentence = outcome(*override.split())
    assert_one_sentence(sentence)
    assert all(word in sentence for word in words), sentence


def test_a_players_learning_rate_is_set_as_the_configuration_file_shows():
    trainer = outcome("optimizer.player_lr={value: 2.0e-3, density: 1.0e-3}")
    assert isinstance(trainer, Trainer), trainer
    assert trainer.stepper.learning_rates() == {"value": 2.0e-3, "density": 1.0e-3}


PROBLEM_FIELDS = [
    (choice, f"problem.{field}")
    for choice in ("circle", "torus", "manufactured")
    for field in OmegaConf.load(CONFIGS / "problem" / f"{choice}.yaml")
]
OTHER_FIELDS = [
    ("circle", f) for f in known_fields("train") if "." in f and f.split(".")[0] not in ("problem", "hydra")
]
JUNK = st.one_of(
    st.integers(-(10**30), 9).map(str),
    st.floats().map(repr),
    st.sampled_from("null true ??? [] {} [1,2] {a:1} ${nope} ../x é '' 'a b' a=b circle".split(" ")),
    st.text(alphabet="abcxyz0123.-_'\"[]{}:,$ \\", max_size=8),
)


@pytest.mark.nightly
@examples(max_examples=200)
@given(where=st.sampled_from(PROBLEM_FIELDS + OTHER_FIELDS), junk=JUNK)
def test_junk_is_accepted_or_refused_in_one_sentence_but_never_breaks(where, junk):
    problem, field = where
    result = outcome(f"problem={problem}", f"{field}={junk}")
    torch.set_num_threads(1)
    if isinstance(result, str):
        assert_one_sentence(result)
