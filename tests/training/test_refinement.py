"""Gauss-Newton steps early in training and at the end of a round: where there are any, what takes them, exact repetition."""

import copy
import math

import pytest
import torch

from ocp_torch.problems import Manufactured
from ocp_torch.runs.build import build_trainer
from ocp_torch.steppers.gauss_newton import Refined
from ocp_torch.training import refinement
from ocp_torch.training.budgets import fill
from ocp_torch.training.observer import Observer
from ocp_torch.training.stopping import SOLVED, Preempted, Signals
from support.bits import differences
from support.small import configured, small, state_of

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")

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

    def refined(network, residual, draw, steps, enough, stop, worst):
        assert steps == 3
        drawn.append(draw(4).x)
        if stopping and stopping[0]():
            assert stop()
            return None
        own = copy.deepcopy(network)
        with torch.no_grad():
            for parameter in own.parameters():
                parameter.mul_(0.5)
        return Refined(own, residual=math.inf)

    monkeypatch.setattr(refinement, "bound", lambda *_: 0.0)
    monkeypatch.setattr(refinement, "refined", refined)
    return drawn, stopping


def weights(fields) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in fields.value.parameters()])


def test_both_the_average_and_the_next_round_take_them(halved):
    drawn, _ = halved
    trainer, plain = small(*LITTLE), small(*LITTLE, "trainer.newton_steps=0", "trainer.rounds=1")
    seen = []

    class Seeing(Observer):
        def evaluated(self, trainer, certificate):
            seen.append((trainer.step, weights(trainer.averaged_fields)))

    plain.fit(Observer())
    trainer.fit(Seeing())
    assert len(drawn) == 2
    assert not torch.equal(*drawn)  # each round has states of its own
    (step, looked_at), *_ = seen
    assert step == 20
    assert torch.equal(looked_at, 0.5 * weights(plain.averaged_fields))
    assert trainer.state.refined
    assert trainer.step == 60


@pytest.mark.nightly
def test_a_run_goes_on_to_the_same_bits_from_anywhere(halved, tmp_path):
    class Saving(Observer):
        def stepped(self, trainer, report, log):
            trainer.save(tmp_path / f"{trainer.step}.pt")

        def extended(self, trainer):
            trainer.save(tmp_path / "after.pt")

    whole = small(*LITTLE)
    whole.fit(Saving())
    for name in ("20", "after", "21"):
        resumed = small(*LITTLE)
        resumed.resume(tmp_path / f"{name}.pt")
        resumed.fit(Observer())
        assert differences(state_of(resumed), state_of(whole)) == [], name


def test_those_that_make_the_bound_worse_are_not_taken(halved, monkeypatch):
    trainer, plain = small(*LITTLE, "trainer.rounds=1"), small(*LITTLE, "trainer.newton_steps=0", "trainer.rounds=1")
    bounds = iter((1.0, 2.0))  # of the refined, of the other
    monkeypatch.setattr(refinement, "bound", lambda *_: next(bounds))
    for run in (trainer, plain):
        run.fit(Observer())
    assert torch.equal(weights(trainer.averaged_fields), weights(plain.averaged_fields))


@pytest.mark.nightly
@pytest.mark.parametrize(
    "how",
    [
        "a signal",
        pytest.param("asked to stop", marks=pytest.mark.nightly),
        pytest.param("late", marks=pytest.mark.nightly),
    ],
)
def test_what_ends_them_ends_them_soon_and_they_are_made_anew(halved, how, tmp_path):
    _, stopping = halved
    whole = small(*LITTLE)
    whole.fit(Observer())
    trainer, signals = small(*LITTLE), Signals()

    def come():
        if how == "asked to stop":
            trainer.asked = True
        else:
            signals.received = 15
        return how != "late"  # after the last step

    stopping.append(come)
    if how == "asked to stop":
        trainer.fit(Observer(), tmp_path / "last.pt")
    else:
        with pytest.raises(Preempted):
            trainer.fit(Observer(), tmp_path / "last.pt", signals)
    stopping.clear()
    assert trainer.step == 20
    assert trainer.state.refined == (how == "late")
    resumed = small(*LITTLE)
    resumed.resume(tmp_path / "last.pt")
    resumed.fit(Observer())
    assert differences(state_of(resumed), state_of(whole)) == []


def test_they_end_where_a_run_has_no_seconds_left():
    trainer = small(*LITTLE, "trainer.max_seconds=1000")
    trainer.state.step, trainer.state.elapsed = 20, 999.999
    before = weights(trainer.averaged_fields)
    refinement.refine(trainer.evaluator, trainer.settings, trainer.run, trainer.ranks, lambda: False)
    assert not trainer.state.refined
    assert torch.equal(weights(trainer.averaged_fields), before)


def test_a_checkpoint_from_before_there_were_any_goes_on(tmp_path):
    trainer = small(*LITTLE)
    state = trainer.state.state_dict()
    del state["refined"]
    trainer.state.load_state_dict(state, trainer.settings)
    assert trainer.state.refined


@pytest.mark.parametrize(
    ("overrides", "some"),
    [
        (("problem=manufactured",), True),
        (("problem=manufactured", "method=pd"), True),
        pytest.param(("problem=manufactured", "problem.dim=4"), True, marks=pytest.mark.nightly),
        pytest.param(("problem=manufactured", "problem.dim=6"), True, marks=pytest.mark.nightly),
        (("problem=manufactured", "problem.noise=0.1"), False),
        (("problem=manufactured", "optimizer=sgd"), False),
        (("problem=manufactured", "trainer.steps=20"), False),
        (("problem=pendulum",), False),
    ],
)
def test_there_are_some_by_default_where_they_were_found_to_help(overrides, some):
    assert (build_trainer(configured("trainer.device=cpu", *overrides)).settings.newton_steps > 0) == some


def test_they_are_tried_early_where_nobody_asked_for_so_many_steps_and_only_v_is_trained():
    after = lambda *more: fill(configured("problem=manufactured", *more), Manufactured(dim=1))["trainer"][
        "newton_after"
    ]
    assert after("method=dual") > 0
    for more in (("method=pd",), ("method=primal",), ("method=dual", "trainer.steps=500")):
        assert after(*more) == 0
    assert after("method=dual", "trainer.steps=500", "trainer.newton_after=60") == 60


EARLY = ("method=dual", "trainer.newton_steps=3", "trainer.newton_after=7")


@pytest.fixture
def solved(monkeypatch):
    """In place of the steps the last layer becomes 0. Gives the states drawn each time."""
    found = []

    def refined(network, residual, draw, steps, enough, stop, worst):
        own = copy.deepcopy(network)
        own.head.weight.data.zero_()
        found.append(draw(4).x)
        return Refined(own, residual=0.0)

    monkeypatch.setattr(refinement, "bound", lambda *_: 0.0)
    monkeypatch.setattr(refinement, "refined", refined)
    return found


def agreeing(trainer, does):
    """Whether the looks of ``trainer`` find a good gap."""
    trainer.evaluator.reaches = lambda gap, run: does
    return trainer


def test_training_ends_once_the_equation_is_solved(solved, tmp_path):
    trainer = agreeing(small(*EARLY), True)
    assert trainer.fit(Observer(), tmp_path / "last.pt") == SOLVED
    assert trainer.step == 7
    assert trainer.samples == 7 * trainer.settings.batch + refinement.COMPARISON_STATES + 4
    assert not trainer.averaged_fields.value.head.weight.any()
    assert not trainer.fields.value.head.weight.any()
    assert "solve the Hamilton-Jacobi-Bellman equation" in trainer.why_stopped
    resumed = small(*EARLY)
    resumed.resume(tmp_path / "last.pt")
    assert resumed.fit(Observer()) == SOLVED
    assert resumed.step == 7


def test_a_resume_that_asks_for_all_steps_makes_them(solved, tmp_path):
    agreeing(small(*EARLY), True).fit(Observer(), tmp_path / "last.pt")
    resumed = small("method=dual", "trainer.newton_steps=0", "trainer.newton_after=0")
    resumed.resume(tmp_path / "last.pt")
    assert resumed.fit(Observer()) == "steps"
    assert resumed.step > 7


@pytest.mark.parametrize("why", ["a look disagrees", "the slack is not small", "the gap is not that asked for"])
def test_else_training_goes_on_as_if_nothing_had_been_tried(solved, monkeypatch, why):
    trainer, plain = small(*EARLY), small("method=dual", "trainer.newton_steps=0")
    if why == "a look disagrees":
        agreeing(trainer, False)
    elif why == "the slack is not small":
        agreeing(trainer, True)
        monkeypatch.setattr(refinement, "SOLVED_SLACK", -1.0)
    else:
        trainer = small(*EARLY, "trainer.target_gap=1e-9", "trainer.evaluate_every=100")
        trainer.evaluator.reaches = lambda gap, run: gap > 1e-9
    seen = {trainer: {}, plain: {}}

    class Seeing(Observer):
        def stepped(self, trainer, report, log):
            seen[trainer][trainer.step] = torch.cat([weights(trainer.fields), weights(trainer.averaged_fields)])

    for run in (trainer, plain):
        run.fit(Seeing())
    assert len(solved) == 2  # early, and at the end
    assert not trainer.state.solved
    assert list(seen[trainer]) == list(seen[plain]) == list(range(1, 21))
    assert all(torch.equal(seen[trainer][k], seen[plain][k]) for k in seen[plain])


@pytest.mark.parametrize("how", ["a signal", "asked to stop"])
def test_early_steps_that_are_cut_off_are_made_anew(solved, monkeypatch, how, tmp_path):
    whole = agreeing(small(*EARLY), True)
    whole.fit(Observer())
    trainer, signals, exact = agreeing(small(*EARLY), True), Signals(), refinement.refined

    def cut(network, residual, draw, steps, enough, stop, worst):
        if how == "a signal":
            signals.received = 15
        else:
            trainer.asked = True
        return None if stop() else exact(network, residual, draw, steps, enough, stop, worst)

    monkeypatch.setattr(refinement, "refined", cut)
    if how == "asked to stop":
        trainer.fit(Observer(), tmp_path / "last.pt")
    else:
        with pytest.raises(Preempted):
            trainer.fit(Observer(), tmp_path / "last.pt", signals)
    assert (trainer.step, trainer.state.refined) == (7, False)
    monkeypatch.setattr(refinement, "refined", exact)
    resumed = agreeing(small(*EARLY), True)
    resumed.resume(tmp_path / "last.pt")
    resumed.fit(Observer())
    assert differences(state_of(resumed), state_of(whole)) == []


@pytest.mark.nightly
@pytest.mark.parametrize(("dim", "more"), [(1, ()), (2, ()), (3, ("problem.exponent=1.5",)), (5, ())])
def test_smooth_problems_are_solved_early_and_well(dim, more):
    overrides = ("problem=manufactured", f"problem.dim={dim}", f"problem.seed={dim}", "method=dual", *more)
    trainer = build_trainer(configured("trainer.device=cpu", *overrides))
    assert trainer.fit(Observer()) == SOLVED
    x = torch.rand(4096, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    exact = trainer.problem.exact_value(x)
    error = (trainer.averaged_fields.value.double()(x) - exact).abs().mean() / exact.std()
    assert float(error) < 1e-3
    states = torch.rand(2**15, dim, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    value = trainer.averaged_fields.value.double()
    _, largest = refinement.worst_states(trainer.problem, value, states)
    assert largest < 3e-3 * float(exact.std())  # no spikes: bounds that need no M are narrow too


@pytest.mark.nightly
def test_a_smooth_problem_is_solved_to_many_more_digits():
    def slack(*more):
        trainer = build_trainer(
            configured(
                "trainer.device=cpu", "problem=manufactured", "problem.dim=1", "method=dual", "trainer.steps=300", *more
            )
        )
        trainer.fit(Observer())
        with torch.no_grad():
            samples = trainer.problem.independent_samples(4096)
            generator = trainer.objective.generator(samples)
            return float(generator.hjb_slack(generator.jet(trainer.averaged_fields.value.double())).abs().mean())

    assert slack() < 0.1 * slack("trainer.newton_steps=0")
