"""Gauss-Newton steps at the end of a round: where there are any, what takes them, and exact repetition."""

import copy

import pytest
import torch

from ocp_torch.problems import Manufactured
from ocp_torch.runs.build import build_trainer
from ocp_torch.training import refinement
from ocp_torch.training.budgets import fill
from ocp_torch.training.observer import Silent
from ocp_torch.training.stopping import Preempted, Signals
from support.bits import differences
from support.small import configured, small, state_of

LITTLE = (
    "method=dual",
    "trainer.newton_steps=3",
    "trainer.rounds=2",
    "trainer.evaluate_every=20",
    "trainer.good_gap=1e-9",
)


@pytest.fixture
def halved(monkeypatch):
    """In place of the steps weights are halved. Gives the states drawn each time, and a list of what comes meanwhile."""
    drawn, stopping = [], []

    def refined(network, residual, draw, steps, stop):
        assert steps == 3
        drawn.append(draw(4).x)
        if stopping and stopping[0]():
            assert stop()
            return None
        own = copy.deepcopy(network)
        with torch.no_grad():
            for parameter in own.parameters():
                parameter.mul_(0.5)
        return own

    monkeypatch.setattr(refinement, "bound", lambda *_: 0.0)
    monkeypatch.setattr(refinement, "refined", refined)
    return drawn, stopping


def weights(fields) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in fields.value.parameters()])


def test_both_the_average_and_the_next_round_take_them(halved):
    drawn, _ = halved
    trainer, plain = small(*LITTLE), small(*LITTLE, "trainer.newton_steps=0", "trainer.rounds=1")
    seen = []

    class Seeing(Silent):
        def evaluated(self, trainer, certificate):
            seen.append((trainer.step, weights(trainer.averaged_fields)))

    plain.fit(Silent())
    trainer.fit(Seeing())
    assert len(drawn) == 2
    assert not torch.equal(*drawn)  # each round has states of its own
    (step, looked_at), *_ = seen
    assert step == 20
    assert torch.equal(looked_at, 0.5 * weights(plain.averaged_fields))
    assert trainer.state.refined
    assert trainer.step == 60


def test_a_run_goes_on_to_the_same_bits_from_anywhere(halved, tmp_path):
    class Saving(Silent):
        def stepped(self, trainer, report, log):
            trainer.save(tmp_path / f"{trainer.step}.pt")

        def extended(self, trainer):
            trainer.save(tmp_path / "after.pt")

    whole = small(*LITTLE)
    whole.fit(Saving())
    for name in ("20", "after", "21"):
        resumed = small(*LITTLE)
        resumed.resume(tmp_path / f"{name}.pt")
        resumed.fit(Silent())
        assert differences(state_of(resumed), state_of(whole)) == [], name


def test_those_that_make_the_bound_worse_are_not_taken(halved, monkeypatch):
    trainer, plain = small(*LITTLE, "trainer.rounds=1"), small(*LITTLE, "trainer.newton_steps=0", "trainer.rounds=1")
    bounds = iter((1.0, 2.0))  # of the refined, of the other
    monkeypatch.setattr(refinement, "bound", lambda *_: next(bounds))
    for run in (trainer, plain):
        run.fit(Silent())
    assert torch.equal(weights(trainer.averaged_fields), weights(plain.averaged_fields))


@pytest.mark.parametrize("how", ["a signal", "asked to stop", "late"])
def test_what_ends_them_ends_them_soon_and_they_are_made_anew(halved, how, tmp_path):
    _, stopping = halved
    whole = small(*LITTLE)
    whole.fit(Silent())
    trainer, signals = small(*LITTLE), Signals()

    def come():
        if how == "asked to stop":
            trainer.asked = True
        else:
            signals.received = 15
        return how != "late"  # after the last step

    stopping.append(come)
    if how == "asked to stop":
        trainer.fit(Silent(), tmp_path / "last.pt")
    else:
        with pytest.raises(Preempted):
            trainer.fit(Silent(), tmp_path / "last.pt", signals)
    stopping.clear()
    assert trainer.step == 20
    assert trainer.state.refined == (how == "late")
    resumed = small(*LITTLE)
    resumed.resume(tmp_path / "last.pt")
    resumed.fit(Silent())
    assert differences(state_of(resumed), state_of(whole)) == []


def test_they_end_where_a_run_has_no_seconds_left():
    trainer = small(*LITTLE, "trainer.max_seconds=1000")
    trainer.state.step, trainer.state.elapsed = 20, 999.999
    before = weights(trainer.averaged_fields)
    refinement.refine(trainer, Silent(), lambda: False)
    assert not trainer.state.refined
    assert torch.equal(weights(trainer.averaged_fields), before)


def test_a_checkpoint_from_before_there_were_any_goes_on(tmp_path):
    trainer = small(*LITTLE)
    state = trainer.state_dict()
    del state["refined"]
    trainer.state.load_state_dict(state, trainer.settings)
    assert trainer.state.refined


@pytest.mark.parametrize(
    ("overrides", "some"),
    [
        (("problem=manufactured",), True),
        (("problem=manufactured", "method=pd"), True),
        (("problem=manufactured", "problem.dim=4"), False),
        (("problem=manufactured", "problem.noise=0.1"), False),
        (("problem=manufactured", "optimizer=sgd"), False),
        (("problem=manufactured", "trainer.steps=20"), False),
        (("problem=pendulum",), False),
    ],
)
def test_there_are_some_by_default_where_they_were_found_to_help(overrides, some):
    assert (build_trainer(configured("trainer.device=cpu", *overrides)).settings.newton_steps > 0) == some


@pytest.mark.parametrize(
    ("override", "steps"),
    [("method.residual=0.3", 350), ("trainer.newton_steps=0", 1000), ("model=sobolev", 1000), ("optimizer=adam", 1000)],
)
def test_rounds_are_short_only_where_such_steps_end_them(override, steps):
    config = configured("problem=manufactured", "problem.dim=5", "method=dual", override)
    assert fill(config, Manufactured(dim=5))["trainer"]["steps"] == steps


def test_rounds_on_recordings_are_not_short(monkeypatch):
    monkeypatch.setattr(Manufactured, "has_simulator", False)
    config = configured("problem=manufactured", "problem.dim=5", "method=dual")
    assert fill(config, Manufactured(dim=5))["trainer"]["steps"] == 1000


@pytest.mark.nightly
def test_a_smooth_problem_is_solved_to_many_more_digits():
    def slack(*more):
        trainer = build_trainer(
            configured(
                "trainer.device=cpu", "problem=manufactured", "problem.dim=1", "method=dual", "trainer.steps=300", *more
            )
        )
        trainer.fit(Silent())
        with torch.no_grad():
            samples = trainer.problem.independent_samples(4096)
            generator = trainer.objective.generator(samples)
            return float(generator.hjb_slack(generator.jet(trainer.averaged_fields.value.double())).abs().mean())

    assert slack() < 0.1 * slack("trainer.newton_steps=0")
