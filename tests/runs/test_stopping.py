"""When a run stops and why; what it says when it goes wrong, and what it hands out then."""

import json
import math

import pytest
import torch

from ocp_torch import load_controller
from ocp_torch.errors import InputError
from ocp_torch.objectives import Objective
from ocp_torch.problems import Circle
from ocp_torch.problems.samples import Samples
from ocp_torch.runs.build import build_certificate_settings
from ocp_torch.runs.run import run_to_end
from ocp_torch.steppers import NonFiniteError
from ocp_torch.steppers.nonfinite import first_nonfinite
from ocp_torch.training.evaluator import Evaluator
from ocp_torch.training.health import Evaluation, Health, best_constant
from ocp_torch.training.monitor import Observer
from ocp_torch.training.stopping import postpone
from ocp_torch.training.trainer import Trainer
from support.looks import LOWER, certificate, quick
from support.small import small

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")

WAY = ("method=dual", "trainer.evaluate_every=4", "trainer.figures=false")


def run(trainer, folder, monkeypatch, gap, certified=lambda trainer: None, **rest):
    """A session whose looks have ``gap`` and whose certificates ``certified``; what was certified, and the certificate."""
    tried = []
    monkeypatch.setattr(Evaluator, "evaluate", quick(gap, **rest))

    def certify(trainer, settings, fields=None, run=None):
        tried.append((trainer.step, {n: t.clone() for n, t in fields.state_dict().items()}))
        return certificate(trainer.run, gap(trainer), certified(trainer), **rest)

    monkeypatch.setattr(Trainer, "certify", certify)
    return tried, run_to_end(trainer, build_certificate_settings(trainer.config), folder)


def test_a_target_gap_stops_the_run_once_a_certificate_has_it(tmp_path, monkeypatch):
    """Good looks begin at step 4, good certificates at step 9: those in between are tried and training goes on."""
    trainer = small(*WAY, "trainer.target_gap=0.02", "trainer.steps=40")
    tried, made = run(trainer, tmp_path, monkeypatch, lambda t: 0.01, lambda t: 0.015 if t.step >= 9 else 0.1)
    assert [step for step, _ in tried] == [4, 8, 12]
    assert (trainer.step, made.run.stopped) == (12, "target_gap")
    assert json.loads((tmp_path / "certificate.json").read_text())["stopped"] == "target_gap"


def test_a_certificate_that_never_reaches_the_target_is_tried_ever_more_rarely(tmp_path, monkeypatch):
    trainer = small(*WAY, "trainer.target_gap=0.02", "trainer.steps=100")
    tried, made = run(trainer, tmp_path, monkeypatch, lambda t: 0.01, lambda t: 0.1)
    assert [step for step, _ in tried] == [4, 8, 12, 16, 20, 28, 36, 48, 60, 76, 96, 100]
    assert made.run.stopped == "steps"


def test_a_run_killed_while_a_certificate_is_tried_tries_it_again(tmp_path, monkeypatch):
    monkeypatch.setattr(Evaluator, "evaluate", quick(lambda t: 0.01))
    way = (*WAY, "trainer.target_gap=0.02", "trainer.steps=40")
    first = small(*way)
    assert first.fit(Observer(), tmp_path / "last.pt") == "target_gap"
    second = small(*way)
    second.resume(tmp_path / "last.pt")
    assert second.fit(Observer()) == "target_gap"
    assert second.step == first.step == 4
    postpone(second.state)
    assert second.fit(Observer()) == "target_gap"
    assert second.step == 8


def test_no_gap_is_no_reason_to_stop(tmp_path, monkeypatch):
    trainer = small(*WAY, "trainer.target_gap=0.02")
    tried, made = run(trainer, tmp_path, monkeypatch, lambda t: None, lambda t: 0.001)
    assert [step for step, _ in tried] == [20]
    assert made.run.stopped == "steps"


def test_seconds_stop_a_run_and_those_before_a_resume_count(tmp_path):
    way = ("method=dual", "trainer.steps=100000", "trainer.max_seconds=0.3")
    trainer = small(*way)
    assert trainer.fit(Observer(), tmp_path / "last.pt") == "max_seconds"
    assert 0 < trainer.step < 100_000
    again = small(*way)
    again.resume(tmp_path / "last.pt")
    assert again.fit(Observer()) == "max_seconds"
    assert again.step == trainer.step
    more = small(*way[:2], "trainer.max_seconds=0.6")
    more.resume(tmp_path / "last.pt")
    more.fit(Observer())
    assert more.step > trainer.step


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("trainer.target_gap=0", "trainer.target_gap"),
        ("trainer.max_seconds=-1", "trainer.max_seconds"),
        ("trainer.keep=0", "trainer.keep"),
        ("trainer.target_gap=abc", "trainer.target_gap"),
    ],
)
def test_wrong_limits_are_refused(override, words):
    with pytest.raises(InputError, match=words):
        small(*WAY, override)


def test_a_target_that_could_never_be_seen_to_be_reached_is_refused():
    with pytest.raises(InputError, match=r"trainer\.evaluate_every is 0"):
        small("method=dual", "trainer.target_gap=0.1")
    with pytest.raises(InputError, match=r"trainer\.target_gap.*lower bound"):
        small("method=primal", "trainer.evaluate_every=4", "trainer.target_gap=0.1")


def test_fields_that_became_worse_are_not_handed_out(tmp_path, monkeypatch):
    """The best evaluation is at step 8 of 20; the controller and the certificate are of that step, and say so."""
    trainer = small(*WAY)
    saved = {}

    class Saver(Observer):
        def evaluated(self, trainer, certificate):
            saved[trainer.step] = {n: t.clone() for n, t in trainer.averaged_fields.state_dict().items()}

    monkeypatch.setattr("ocp_torch.runs.run.Monitor.evaluated", Saver.evaluated)
    tried, made = run(trainer, tmp_path, monkeypatch, lambda t: 0.1 + abs(t.step - 8) / 100.0)
    ((step, fields),) = tried
    assert step == 20
    assert all(torch.equal(fields[n], saved[8][n]) for n in fields)
    (sentence,) = [w for w in made.warnings if "handed out" in w]
    assert "step 8" in sentence
    assert "(a gap of 22 % against a gap of 10 %)" in sentence
    controller = load_controller(tmp_path / "controller.safetensors")
    assert all(torch.equal(t, saved[8][n]) for n, t in controller.fields.state_dict().items())
    assert sentence in controller.certificate["warnings"]


@pytest.mark.parametrize(
    ("problem", "lower", "perf", "handed"),
    [
        ("arm", 0.04, 0.055, False),
        ("arm", 0.05, 0.06, True),
        ("circle", 0.04, 0.055, True),
        ("circle", 0.05, 0.055, False),
    ],
)
def test_where_v_is_trained_on_for_its_bound_a_look_decides_by_the_performance(
    monkeypatch, problem, lower, perf, handed
):
    """After a look with a bound of 0.05 and a performance of 0.055 comes one with ``lower`` and ``perf``."""
    trainer = small(f"problem={problem}", *WAY)
    trainer.state.step = 4
    trainer.health.evaluated(trainer.evaluator.evaluation(certificate(trainer.run, 0.1)), trainer.averaged_fields)
    trainer.state.step = 20
    monkeypatch.setattr("support.looks.LOWER", lower)
    monkeypatch.setattr(trainer.evaluator, "evaluate", lambda run: certificate(run, perf / lower - 1.0))
    fields, sentence = trainer.evaluator.choose(trainer.run)
    assert (fields is not trainer.averaged_fields) == handed
    assert (sentence is not None) == handed


def test_the_last_fields_are_handed_out_unless_they_are_clearly_worse(tmp_path, monkeypatch):
    trainer = small(*WAY)
    tried, made = run(trainer, tmp_path, monkeypatch, lambda t: 0.1 if t.step < 20 else 0.1)
    last = trainer.averaged_fields.state_dict()
    assert all(torch.equal(t, last[n]) for n, t in tried[0][1].items())
    assert not any("handed out" in w for w in made.warnings)
    noisy, worse = Evaluation(1, 0.10, 1.0, 0.02), Evaluation(2, 0.12, 1.0, 0.02)
    assert noisy.better_than(worse)
    assert not noisy.better_than(worse, sure=True)
    assert noisy.better_than(Evaluation(2, 0.15, 1.0, 0.02), sure=True)
    assert noisy.better_than(Evaluation(2, None, 0.1, 0.0))
    # A look does not see whether `F_M` counts: where that would turn it round, nothing is sure.
    look = lambda step, gap, supposed: Evaluation(step, gap, 1.0, 0.01, supposed)
    assert not look(1, 0.07, 0.03).better_than(look(2, 0.12, 0.01), sure=True)
    assert look(1, 0.07, 0.01).better_than(look(2, 0.12, 0.03), sure=True)
    assert look(1, 0.07, None).better_than(look(2, 0.12, 0.03), sure=True)
    assert Evaluation(1, None, 1.0, 0.01).better_than(Evaluation(2, None, 1.1, 0.01), sure=True)
    assert not Evaluation(1, None, 1.0, 0.06).better_than(Evaluation(2, None, 1.1, 0.06), sure=True)
    assert not Evaluation(1, None, None, 0.0).better_than(None)


def test_a_hopeless_run_is_told_plainly(tmp_path, monkeypatch, caplog):
    trainer = small(*WAY)
    monkeypatch.setattr("support.looks.LOWER", 0.001)
    with caplog.at_level("WARNING"):
        _, made = run(trainer, tmp_path, monkeypatch, lambda t: 80.0, zero=0.05)
    assert any("best constant V" in w for w in made.warnings)
    assert sum("worse than doing nothing" in w for w in made.warnings) == 1
    assert "step 12: the lower bound" in caplog.text
    monkeypatch.setattr("support.looks.LOWER", LOWER)
    _, made = run(small(*WAY), tmp_path / "good", monkeypatch, lambda t: 0.1)
    assert made.warnings == []


def test_the_best_constant_is_the_best_of_all_constants():
    problem, constants = Circle(), small("method=dual").constants
    x = (torch.arange(2**15, dtype=torch.float64).unsqueeze(-1) + 0.5) / 2**15
    f = problem.state_cost(x)
    values = [float(c - constants.M * (c - f).clamp_min(0.0).mean()) for c in torch.linspace(0.0, 0.3, 600)]
    assert best_constant(problem, constants, 0) == pytest.approx(max(values), rel=2e-4)


def test_norms_that_grow_without_end_are_told_once_with_what_would_help():
    health, weights = Health(unit=1.0), [torch.ones(4)]
    assert health.stepped(1, {"value": torch.tensor(-0.5)}, {"value": weights}) == []
    assert health.stepped(2, {"value": torch.tensor(-5e3)}, {"value": [90.0 * w for w in weights]}) == []
    first = health.stepped(3, {"value": torch.tensor(2e4)}, {"value": [200.0 * w for w in weights]})
    assert len(first) == 2
    assert all("diverges" in s and "optimizer.lr" in s and "step 3" in s for s in first)
    assert health.stepped(4, {"value": torch.tensor(3e4)}, {"value": [300.0 * w for w in weights]}) == []
    assert health.notes == first


def test_a_run_that_diverges_hands_out_its_best_look_and_still_fails(tmp_path, monkeypatch):
    trainer = small(*WAY)
    step = trainer.stepper.step

    def failing(batches, phase):
        if trainer.step == 10:
            raise NonFiniteError("the loss of player 'value' is not finite at x = [0.5].")
        return step(batches, phase)

    trainer.stepper.step = failing
    with pytest.raises(InputError, match=r"Training stopped at step 10, before the update: .*best evaluation before"):
        run(trainer, tmp_path, monkeypatch, lambda t: 0.1)
    made = json.loads((tmp_path / "certificate.json").read_text())
    assert made["stopped"] == "not_finite"
    assert any("step 4" in w and "x = [0.5]" in w for w in made["warnings"])
    assert load_controller(tmp_path / "controller.safetensors").problem.dim == 1


class Holed(Circle):
    """Its cost is not a number near one state."""

    bad = math.nan

    def state_cost(self, x):
        return super().state_cost(x).where((x[:, 0] - 0.25).abs() > 0.02, self.bad)


@pytest.mark.parametrize("stepper", ["simultaneous", "extragradient"])
def test_what_is_not_finite_is_named_with_the_state_where_it_is(stepper):
    trainer = small("method=dual", "trainer.batch=256", f"stepper={stepper}")
    trainer.problem = trainer.batches.problem = Holed()
    before = {n: t.clone() for n, t in trainer.fields.state_dict().items()}
    with pytest.raises(NonFiniteError, match=r"player 'value' .* at x = \[0\.2[3-6].*state cost") as error:
        trainer.fit(Observer())
    assert "\n" not in str(error.value)
    assert trainer.step == 0
    assert all(torch.equal(t, before[n]) for n, t in trainer.fields.state_dict().items())


class Steep(Objective):
    """A loss that is finite everywhere, with a gradient that is not where the first coordinate is above 0.9."""

    players = {"value": ("value",)}

    def __init__(self):
        """No problem, no bounds."""

    def losses(self, fields, samples: Samples, phase):
        value = fields.value(samples.x)
        far = samples.x[:, 0] > 0.9
        return {"value": value[~far].sum() + (value - value.detach())[far].sqrt().sum()}


def test_a_gradient_that_is_not_finite_is_named_with_its_field_and_state():
    trainer = small("method=dual")
    trainer.stepper.objective = Steep()
    x = torch.linspace(0.0, 0.95, 16).unsqueeze(-1)
    with pytest.raises(NonFiniteError, match=r"gradient .* player 'value' for its value at x = \[0\.95"):
        trainer.stepper.step([Samples.of(trainer.problem, x)], trainer.phase)


def test_weights_that_are_not_finite_are_never_saved(tmp_path):
    trainer = small("method=dual", "trainer.steps=5")
    trainer.save(tmp_path / "last.pt")
    good = (tmp_path / "last.pt").read_bytes()
    with torch.no_grad():
        next(trainer.fields.parameters()).fill_(math.inf)
    with pytest.raises(NonFiniteError, match="weights"):
        trainer.save(tmp_path / "last.pt")
    with pytest.raises(NonFiniteError, match="not finite at any x: the weights of"):
        trainer.fit(Observer(), tmp_path / "last.pt")
    assert (tmp_path / "last.pt").read_bytes() == good


class Spotted(Circle):
    """Noise that is not a number on the left."""

    def noise(self, x):
        return torch.where(x < 0.5, math.nan, 0.1).unsqueeze(-1)


def test_noise_that_is_not_finite_is_named():
    trainer = small("method=dual")
    samples = Samples.of(Spotted(), torch.tensor([[0.7], [0.3]]), divergences=False)
    said = first_nonfinite(trainer.objective, trainer.fields, samples, trainer.phase)
    assert said.endswith(
        "at x = [0.3], where the noise of the problem is not finite; it must be finite on the whole torus"
    )


def test_bounds_that_contradict_each_other_stop_nothing_and_choose_nothing(tmp_path, monkeypatch, caplog):
    """From step 12 on the lower bound is above what the controller costs; the run goes on to its end, hands out the last
    fields, and says so in log, certificate and controller."""
    trainer = small(*WAY, "trainer.target_gap=0.02", "trainer.steps=20")
    with caplog.at_level("WARNING"):
        tried, made = run(trainer, tmp_path, monkeypatch, lambda t: 0.1 if t.step < 12 else -0.1)
    ((step, fields),) = tried
    assert (step, made.run.stopped) == (20, "steps")
    assert all(torch.equal(t, fields[n]) for n, t in trainer.averaged_fields.state_dict().items())
    assert trainer.health.best.step == 4
    assert sum("contradicted each other at step 12" in line for line in caplog.messages) == 1
    said = json.loads((tmp_path / "certificate.json").read_text())
    assert "contradicts" in said["contradiction"]
    assert (said["gap"]["certified"], said["gap"]["simulated"], said["gap"]["lower_from"]) == (None, None, None)
    assert not said["lower"]["F_M"]["counts"]
    assert not said["assumptions"]["hold"]
    assert load_controller(tmp_path / "controller.safetensors").certificate["contradiction"] == said["contradiction"]


@pytest.mark.parametrize(("method", "said"), [("dual", True), ("primal", False)])
def test_a_gap_that_was_not_measured_is_not_said_to_be_met(method, said, monkeypatch):
    monkeypatch.setattr(Evaluator, "evaluate", quick(lambda trainer: 0.01))
    trainer = small(f"method={method}", "trainer.steps=8", "trainer.rounds=2", "trainer.good_gap=0.02")
    assert trainer.fit(Observer()) == "steps"
    assert trainer.step == 8
    assert ("good_gap" in trainer.why_stopped) is said
