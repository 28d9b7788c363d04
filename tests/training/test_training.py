"""Runs: the same seed gives the same bits, also through a checkpoint; a run leaves its documented files and scalars."""

import json
import math

import pytest
import torch
from matplotlib.image import imread
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ocp_torch.certificate.contexts import trained
from ocp_torch.compute import threads
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError
from ocp_torch.runs.build import build_certificate_settings
from ocp_torch.runs.finish import glimpse
from ocp_torch.training.checkpoint import load_checkpoint
from ocp_torch.training.monitor import Observer
from support.bits import differences
from support.small import METHODS, session, small, state_of

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")

STEPPERS, OPTIMIZERS, SAMPLERS = ("simultaneous", "extragradient"), ("sgd", "adam", "soap"), ("uniform", "sobol")
# Every method with every stepper; optimisers and samplers go round, in other orders than in tests/runs/test_resume.py.
WAYS = [
    (
        *METHODS[method],
        f"stepper={stepper}",
        f"optimizer={OPTIMIZERS[(i + j) % 3]}",
        f"sampler={SAMPLERS[i % 2]}",
    )
    for i, method in enumerate(METHODS)
    for j, stepper in enumerate(STEPPERS)
]


class Interruption(Observer):
    """Kills a run in the middle of it."""

    def __init__(self, step: int) -> None:
        self.at = step

    def stepped(self, trainer, report, log):
        if trainer.step == self.at:
            raise KeyboardInterrupt


def test_equal_seeds_give_equal_bits_and_another_seed_does_not():
    first, second, other = (small(f"seed={seed}") for seed in (3, 3, 4))
    for trainer in (first, second, other):
        trainer.fit(Observer())
    assert differences(state_of(first), state_of(second)) == []
    changed = differences(state_of(first)["fields"], state_of(other)["fields"])
    assert any(name.endswith("weight") for name in changed)


@pytest.mark.parametrize("way", WAYS, ids=" ".join)
def test_an_interrupted_run_goes_on_to_the_same_bits(way, tmp_path):
    way = (*way, "trainer.steps=12", "trainer.checkpoint_every=5")
    whole = small(*way)
    start = {k: v.clone() for k, v in whole.fields.state_dict().items()}
    whole.fit(Observer())
    assert differences(start, whole.fields.state_dict()) != []
    file = tmp_path / "last.pt"
    with pytest.raises(KeyboardInterrupt):
        small(*way).fit(Interruption(8), file)
    resumed = small(*way)
    resumed.resume(file)
    assert resumed.step == 5
    resumed.fit(Observer())
    assert resumed.step == whole.step == 12
    assert differences(state_of(resumed), state_of(whole)) == []


@pytest.mark.nightly
@pytest.mark.parametrize(("sampler", "seed"), [("uniform", 0), ("sobol", 1)])
def test_no_state_of_a_training_batch_is_ever_used_for_evaluation(sampler, seed, monkeypatch):
    # Float64 throughout: rounding training states alone would make them differ.
    little = ("certificate.points=128", "certificate.trajectories=2", "certificate.ascents=1")
    way = ("problem=torus", "method=dual", f"sampler={sampler}", "trainer.dtype=float64", f"seed={seed}")
    trainer = small(*way, *little)
    met: dict[str, set] = {"training": set(), "stage": set(), "evaluation": set()}
    phase, cost, fit = ["training"], trainer.problem.state_cost, trained.fit_closed_loop

    def state_cost(x):
        met[phase[-1]].update(tuple(row) for row in x.tolist())
        return cost(x)

    def fit_closed_loop(*arguments):
        phase.append("stage")
        fitted = fit(*arguments)
        phase.pop()
        return fitted

    monkeypatch.setattr(trainer.problem, "state_cost", state_cost)
    monkeypatch.setattr(trained, "fit_closed_loop", fit_closed_loop)
    monkeypatch.setattr(threads, "cores", lambda: 1)  # what a copy of the process meets is not seen here
    trainer.fit(Observer())
    phase.append("evaluation")
    trainer.certify(build_certificate_settings(trainer.config))
    assert len(met["training"]) == 20 * 16
    assert len(met["stage"]) > 500
    assert len(met["evaluation"]) > 500
    assert not met["evaluation"] & (met["training"] | met["stage"])


def test_looking_at_the_bounds_on_the_way_changes_nothing():
    once, often = small(), small("trainer.evaluate_every=10")
    for trainer in (once, often):
        trainer.fit(Observer())
    changed = differences(state_of(once), state_of(often))
    assert all(name.startswith("/watch/") for name in changed), changed


@pytest.mark.parametrize(("steps", "apart"), [(7, 7), (900, 900), (1200, 1200), (2000, 1000), (3601, 901)])
def test_looks_are_evenly_spread_over_the_steps(steps, apart):
    assert small("trainer.evaluate_every=null", f"trainer.steps={steps}").settings.evaluate_every == apart


def test_a_run_that_may_stop_at_a_look_has_one_on_the_way():
    trainer = small("method=dual", "trainer.evaluate_every=null", "trainer.steps=900", "trainer.target_gap=0.01")
    assert trainer.settings.evaluate_every == 450


@pytest.mark.nightly
def test_a_round_ends_with_a_look_but_the_last_one_which_a_certificate_follows():
    class Looks(Observer):
        def __init__(self):
            self.at = []

        def evaluated(self, trainer, certificate):
            self.at.append(trainer.step)

    monitor = Looks()
    trainer = small("trainer.evaluate_every=10", "trainer.rounds=2", "trainer.good_gap=1e-9")
    trainer.fit(monitor)
    assert (monitor.at, trainer.step) == ([10, 20, 30, 40, 50], 60)


RUNS = {
    1: (
        "problem=circle",
        "method=pd",
        "trainer.evaluate_every=10",
        "trainer.log_every=5",
        "certificate.trajectories=2",
    ),
    2: ("problem=torus", "method=dual", "certificate.trajectories=0"),
    3: (
        "problem=manufactured",
        "problem.dim=3",
        "problem.control_dim=2",
        "method=primal",
        "certificate.trajectories=0",
    ),
}


@pytest.fixture(scope="module", params=[1, 2, pytest.param(3, marks=pytest.mark.nightly)], ids=lambda d: f"d={d}")
def run(request, tmp_path_factory):
    """A finished run in its folder, and its configuration."""
    few = ("certificate.points=64", "certificate.replicates=2", "certificate.ascents=1", "certificate.stage.steps=10")
    trainer = small(*RUNS[request.param], *few, "seed=5")
    folder = tmp_path_factory.mktemp("run")
    session(trainer, folder)
    return folder, trainer.config


def test_a_run_leaves_exactly_the_documented_files(run):
    folder, config = run
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    events = {name for name in files if name.startswith("events.out.tfevents.")}
    figures = {name for name in files if name.startswith("figures/") and name.endswith(".png")}
    assert events
    assert figures
    looks = {"checkpoints/best.pt"} if config["trainer"]["evaluate_every"] else set()
    documented = {"checkpoints/last.pt", "certificate.json", "controller.safetensors", "report.html"}
    assert files - events - figures == documented | looks
    for name in figures:
        assert imread(folder / name).std() > 0, f"{name} is blank"
    assert load_checkpoint(folder / "checkpoints" / "last.pt")["step"] == 20
    controller = load_controller(folder / "controller.safetensors")
    assert controller.config == config
    assert controller.certificate == json.loads((folder / "certificate.json").read_text())


NUMBERS = {
    "top": {"schema", "seed", "step", "samples", "train_seconds", "confidence"},
    "lower": {"F_M", "shifted"},
    "upper": {"J", "G", "lagrangian"},
    "perf": {"value", "density"},
    "baseline": {"zero"},
    "share": {"certified", "simulated"},
}


def is_number(value) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def test_certificate_json_has_the_documented_schema_with_numbers_or_null(run):
    folder, config = run
    certificate = json.loads((folder / "certificate.json").read_text())
    groups = {"lower", "upper", "perf", "baseline", "gap", "share", "suboptimality", "assumptions"}
    assert certificate.keys() == NUMBERS["top"] | groups | {
        *("problem", "method", "exact", "warnings", "stopped", "controller", "contradiction"),
    }
    assert certificate["controller"] in ("value", "density", None)
    assert certificate["contradiction"] is None
    assert certificate["confidence"] == config["certificate"]["confidence"]
    assert certificate["stopped"] == "steps"
    assert all(is_number(certificate[name]) for name in NUMBERS["top"])
    assert (certificate["schema"], certificate["seed"], certificate["step"]) == (2, 5, 20)
    assert certificate["samples"] == 20 * 16
    assert certificate["method"] == config["method"]["name"]
    assert certificate["problem"] == config["problem"]["_target_"].rpartition(".")[2].lower()
    assert is_number(certificate["exact"])
    for group in ("lower", "upper", "perf", "baseline"):
        assert certificate[group].keys() == NUMBERS[group]
        for name, estimate in certificate[group].items():
            wanted = {"value", "se", "half_width", "interval"} | ({"bias"} if group in ("perf", "baseline") else set())
            wanted |= {"rests_on", "counts"} if group in ("lower", "upper") else set()
            wanted |= {"controller"} if name == "lagrangian" else set()
            if estimate is None:
                continue
            assert estimate.keys() == wanted, name
            low, high = estimate["interval"]
            assert low <= estimate["value"] <= high
            words = ("controller", "interval", "rests_on", "counts")
            assert all(is_number(v) for k, v in estimate.items() if k not in words), name
            assert set(estimate.get("rests_on", {}).values()) <= {"given", "proved", "searched", "guessed"}
    gap, share, assumptions = (certificate[group] for group in ("gap", "share", "assumptions"))
    assert gap.keys() == {"certified", "simulated", "conditional", "certified_of", "lower_from", "upper_from"}
    certified_of = gap.pop("certified_of")
    assert certified_of.keys() <= certificate["perf"].keys()
    assert all(found is None or is_number(found) for found in certified_of.values())
    assert gap["lower_from"] in (None, "F_M", "shifted")
    assert gap["upper_from"] in (None, "J", "G", "lagrangian")
    assert share.keys() == NUMBERS["share"]
    suboptimality = certificate["suboptimality"]
    assert suboptimality.keys() == {"at_least", "at_most", "takes"}
    assert all(isinstance(sentence, str) for sentence in suboptimality.pop("takes"))
    constants = {"M", "C_V", "C_u", "estimated_sup_occupation", "sup_control", "a_priori_sup_occupation"}
    constants |= {"largest_value", "largest_jump", "smallest_state_cost", "initial_mass"}
    assert assumptions.keys() == constants | {"hold"}
    numbers = [*share.values(), *suboptimality.values(), gap["certified"], gap["simulated"]]
    numbers += [assumptions[name] for name in constants]
    assert all(value is None or is_number(value) for value in numbers)
    assert isinstance(assumptions["hold"], bool)
    assert all(isinstance(warning, str) for warning in certificate["warnings"])


def test_what_a_method_cannot_know_is_null(run):
    folder, config = run
    certificate = json.loads((folder / "certificate.json").read_text())
    method, simulated = config["method"]["name"], config["certificate"]["trajectories"] > 0
    has_value, has_density = method in ("dual", "pd"), method in ("primal", "pd")
    assert all((certificate["lower"][name] is not None) == has_value for name in ("F_M", "shifted"))
    assert has_density <= (certificate["upper"]["J"] is not None)
    assert (certificate["perf"]["value"] is not None) == (has_value and simulated)
    assert (certificate["perf"]["density"] is not None) == (has_density and simulated)
    assert (certificate["baseline"]["zero"] is not None) == simulated


def test_tensorboard_shows_every_group_of_scalars_and_the_exact_optimum(run):
    folder, config = run
    events = EventAccumulator(str(folder))
    events.Reload()
    tags = events.Tags()["scalars"]
    groups = {tag.split("/")[0] for tag in tags}
    assert {"bounds", "loss", "lr", "gradient_norm", "throughput"} <= groups
    assert ("performance" in groups) == (config["certificate"]["trajectories"] > 0)
    certificate = json.loads((folder / "certificate.json").read_text())
    last = {tag: events.Scalars(tag)[-1] for tag in tags if tag.startswith(("bounds/", "performance/"))}
    assert last["bounds/exact"].value == pytest.approx(certificate["exact"])
    for tag, group, name in (("bounds/F_M", "lower", "F_M"), ("bounds/J", "upper", "J")):
        if certificate[group][name] is not None:
            assert last[tag].value == pytest.approx(certificate[group][name]["value"])
            assert last[tag].step == 20
    if config["trainer"]["evaluate_every"]:
        assert [event.step for event in events.Scalars("bounds/F_M")] == [10, 20]
        assert [event.step for event in events.Scalars("loss/value")] == [5, 10, 15, 20]


@pytest.mark.nightly
def test_tensorboard_shows_the_fields_at_each_look_and_at_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr("ocp_torch.runs.run.glimpse", glimpse)
    session(small("method=dual", "trainer.evaluate_every=8", "trainer.figures=true"), tmp_path)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    steps = {tag: [event.step for event in events.Images(tag)] for tag in events.Tags()["images"]}
    assert steps["fields/value"] == steps["fields/control_value"] == [8, 16, 20]
    assert steps["fields/slack"] == [20]


def test_a_run_that_diverges_says_so_and_never_saves_what_is_not_finite(tmp_path):
    trainer = small("method=dual", "optimizer=sgd", "optimizer.lr=1e6", "trainer.checkpoint_every=1")
    with pytest.raises(InputError, match="Training stopped at step .* the loss of player 'value'") as stopped:
        session(trainer, tmp_path)
    assert "\n" not in str(stopped.value)
    assert not (tmp_path / "controller.safetensors").exists()
    saved = load_checkpoint(tmp_path / "checkpoints" / "last.pt")["fields"]
    assert all(torch.isfinite(t).all() for t in saved.values())


def test_a_checkpoint_that_cannot_be_read_is_refused_in_one_sentence(tmp_path):
    file = tmp_path / "last.pt"
    small("trainer.steps=2").fit(Observer(), file)
    whole = file.read_bytes()
    torch.save({"weights": torch.zeros(2)}, tmp_path / "foreign.pt")
    broken = [b"", whole[:1000], whole[: len(whole) // 2], b"PK" + bytes(500), (tmp_path / "foreign.pt").read_bytes()]
    for content in broken:
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"last\.pt") as refused:
            small("trainer.steps=2").resume(file)
        assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match="does not exist"):
        small("trainer.steps=2").resume(tmp_path / "nowhere.pt")


def test_one_flipped_bit_in_a_checkpoint_is_noticed(tmp_path):
    file = tmp_path / "last.pt"
    small("method=dual", "trainer.steps=2").fit(Observer(), file)
    whole = file.read_bytes()
    for position in range(0, len(whole), 101):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << position % 8
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=r"last\.pt"):
            load_checkpoint(file)
    file.write_bytes(whole)
    assert load_checkpoint(file)["step"] == 2
