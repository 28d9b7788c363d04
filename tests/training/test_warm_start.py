"""The warm start: what it fits is the value, a run stopped in it goes on to the same bits, and it knows when to stay out."""

import copy
import math
from dataclasses import replace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ocp_torch.certificate.contexts.trained import TrainedContext
from ocp_torch.certificate.report import table
from ocp_torch.certificate.simulated import candidates
from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.control.controller import Controller
from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.pace import Pace
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields, PeriodicMLP
from ocp_torch.fields.fields import typical_sizes
from ocp_torch.fields.logarithmic import Logarithmic
from ocp_torch.maths.jets import jet
from ocp_torch.problems import PROBLEMS
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.runs.run import run_to_end
from ocp_torch.training import evaluator
from ocp_torch.training.monitor import Observer
from ocp_torch.training.warm_start.grid import GridValues
from ocp_torch.training.warm_start.iteration import GRADIENT_LENGTH, ValueIteration
from ocp_torch.training.warm_start.pieces import Trajectories, lambda_returns, roll
from ocp_torch.training.warm_start.settings import WarmStartSettings
from ocp_torch.training.warm_start.targets import Targets
from support.bits import differences
from support.small import SMALL, configured, small, state_of
from support.zoo import FEW_SMOOTH, NATURAL, QUIET, fresh, on, states

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")
WARM = ("warm_start.mode=on", "warm_start.rounds=12", "warm_start.pieces=16", "warm_start.steps=4")
SWING = ("problem=pendulum", "problem.control_limit=1.0")
# A certificate whose numbers do not matter: controllers that are hardly trained take long to simulate.
FEW = (
    "certificate.points=64",
    "certificate.replicates=2",
    "certificate.trajectories=4",
    "certificate.ascents=2",
)


@pytest.fixture
def little(monkeypatch):
    """Grids, fits, trials and lessons as small as may be: for what does not depend on how good they are."""
    fits, grid = {"iteration.BATCH": 64, "iteration.TEACHING_STEPS": 20}, {"grid.SIDE": 32}
    for name, size in {**fits, **grid, "iteration.TRIAL_STARTS": 16, "trial.TRIAL_TIME": 2.0}.items():
        monkeypatch.setattr(f"ocp_torch.training.warm_start.{name}", size)


@pytest.mark.parametrize("bent", [True, False])
def test_pieces_start_about_a_state_of_rest_at_every_height(bent):
    problem, generator = PROBLEMS["cart_pole"](), torch.Generator().manual_seed(0)
    settings = WarmStartSettings(mode="on", rounds=1, pieces=40, steps=2, trace=0.9)
    pieces = Trajectories(problem, Pace.of(problem), torch.zeros(1, 4), settings, generator, unit=0.01)
    rest = pieces.rest if bent else pieces.rest._replace(bend=torch.zeros(4, 4, dtype=torch.float64))
    x = pieces._about(rest, 4096).double()
    assert x.shape == (4096, 4)
    assert ((x >= 0.0) & (x < 1.0)).all()
    away = (x - rest.at + 0.5).remainder(1.0) - 0.5
    assert float(away.abs().max()) <= 0.25 + 1e-6
    if bent:
        inside = away.abs().amax(dim=-1) < 0.24  # where nothing was cut off
        height = 0.5 * torch.einsum("ni,ij,nj->n", away, rest.bend, away)[inside] / 0.01
        assert 0.05 < float(height.min()) < 0.2
        assert 1.0 < float(height.median()) < 10.0
        assert float(height.max()) > 30.0
    assert len(pieces._draw()) == 40


@pytest.mark.parametrize("trace", [0.0, 0.6, 1.0])
def test_lambda_returns_are_the_weighted_sum_of_all_returns_of_n_steps(trace):
    rho, step, K = 1.3, 0.2, 5
    costs, values = torch.rand(K, 3).double(), torch.rand(K + 1, 3).double()
    kept = math.exp(-rho * step)

    def of_n_steps(k: int, n: int) -> torch.Tensor:
        paid = sum((1.0 - kept) * kept**j * costs[k + j] for j in range(n))
        return paid + kept**n * values[k + n]

    found = lambda_returns(costs, values, rho, step, trace)
    for k in range(K):
        last = K - k
        expected = trace ** (last - 1) * of_n_steps(k, last)
        expected = expected + sum((1.0 - trace) * trace ** (n - 1) * of_n_steps(k, n) for n in range(1, last))
        torch.testing.assert_close(found[k], expected)


@on(QUIET)
def test_the_exact_value_is_a_fixed_point_to_first_order_in_the_step_at_least(problem):
    x, errors = states(problem, 64), []
    for halvings in (0, 1):
        pace, steps = Pace(0.02 / problem.discount / 2**halvings, 1), 10 * 2**halvings
        ran = roll(problem, problem.exact_value, x, pace, steps, torch.Generator())
        y = lambda_returns(ran.costs, ran.values, problem.discount, pace.step, 0.95)
        errors.append(float((y[0] - ran.values[0]).abs().mean()))
    spread = float(ran.values[0].std())
    assert errors[1] < 0.6 * errors[0] < 0.01 * spread or errors[0] < 1e-4 * spread


@pytest.mark.nightly
@on([name for name in FEW_SMOOTH if name not in QUIET])
def test_returns_along_noisy_pieces_have_the_value_as_their_mean(problem):
    x = states(problem, 4).repeat_interleave(4096, dim=0)
    pace = Pace(0.01 / problem.discount, 1)
    ran = roll(problem, problem.exact_value, x, pace, 20, torch.Generator().manual_seed(1))
    y = lambda_returns(ran.costs, ran.values, problem.discount, pace.step, 0.9)[0]
    off = (y - ran.values[0]).reshape(4, -1)
    se = off.std(dim=1) / math.sqrt(off.shape[1])
    assert float(se.min()) > 0.0
    assert (off.mean(dim=1).abs() < 4.0 * se + 0.005 * float(ran.values[0].std())).all()


class Stop(Observer):
    """Kills a run in the middle of its warm start, a round after a trial."""

    def warmed(self, trainer, looked):
        warm = trainer.state.warm
        if warm.round == warm.source.trial_every + 1:
            raise KeyboardInterrupt


PLAIN = ("problem=circle", "method=dual", "model.modes=3")
NOISY = ("problem=cart_pole", "method=pd", "problem.noise=1e-3", "warm_start.rounds=24")
ON_A_GRID = (*SWING, "method=dual", "warm_start.rounds=42")


@pytest.mark.usefixtures("little")
@pytest.mark.nightly
@pytest.mark.parametrize("way", [PLAIN, NOISY, ON_A_GRID])
def test_a_run_that_is_killed_in_its_warm_start_goes_on_to_the_same_bits(way, tmp_path):
    way = (*WARM, *way, "trainer.steps=3")
    whole = small(*way)
    whole.fit(Observer())
    assert whole.state.warm.done
    assert whole.step == 3
    with pytest.raises(KeyboardInterrupt):
        small(*way).fit(Stop(), tmp_path / "last.pt")
    resumed = small(*way)
    resumed.resume(tmp_path / "last.pt")
    assert (resumed.state.warm.round, resumed.fresh) == (resumed.state.warm.source.trial_every, False)
    resumed.fit(Observer(), tmp_path / "last.pt")
    assert differences(state_of(resumed), state_of(whole)) == []
    again = small(*way)
    again.resume(tmp_path / "last.pt")
    assert differences(again.state.state_dict()["fields"], whole.state.state_dict()["fields"]) == []


@pytest.mark.nightly
@pytest.mark.usefixtures("little")
def test_the_controller_of_the_warm_start_is_a_candidate_and_can_be_handed_out(tmp_path):
    trainer = small(*WARM, *FEW, "model.modes=3", "method=dual", "trainer.figures=false", "certificate.tolerance=0.05")
    certificate = run_to_end(trainer, build_certificate_settings(trainer.config), tmp_path)
    assert {name for name, perf in certificate.perf.items() if perf is not None} == {"value", "trajectories"}
    # The bounds that take a divergence are of the controller that acts at every instant.
    assert certificate.followed == "value"
    assert certificate.about["lagrangian"] in ("value", None)
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert (
        [e.step for e in events.Scalars("warm_start/cost")]
        == [e.step for e in events.Scalars("warm_start/loss")]
        == [10, 12]
    )
    fields = trainer.averaged_fields
    x = states(trainer.problem, 16, dtype=torch.float32)
    exact = copy.deepcopy(fields).double()  # as controllers compute
    of = lambda V: HeldPolicy(trainer.problem, V, Pace.of(trainer.problem))(x.double()).float()
    best = of(exact.trajectory_value)
    assert (best != of(exact.value)).any()
    made = Controller(
        trainer.problem, fields, trainer.constants, None, "trajectories", trainer.config["model"], {}, trainer.config
    )
    made.save(tmp_path / "other.safetensors")
    loaded = load_controller(tmp_path / "other.safetensors")
    assert torch.equal(loaded(x), best)
    assert loaded.held_for == Pace.of(trainer.problem).step
    handed_out = load_controller(tmp_path)
    assert (handed_out.held_for is None) == (handed_out.kind != "trajectories")
    assert handed_out.certificate.get("held_for") == handed_out.held_for


@pytest.mark.usefixtures("little")
@pytest.mark.nightly
def test_looks_remember_the_controller_of_the_warm_start_until_its_weights_or_the_seed_change(monkeypatch):
    trainer = small(*SWING, *WARM, *FEW, "method=dual")
    made = []

    def simulated(problem, policy, **how):
        made.append(isinstance(policy, HeldPolicy))
        return Simulation(problem, policy, **how)

    monkeypatch.setattr(candidates, "Simulation", simulated)

    def looked(seed: int = 0):
        made.clear()
        found = trainer.evaluator.quick(replace(trainer.run, seed=seed), replace(evaluator.QUICK, tolerance=1.0))
        return sum(made), found.perf["trajectories"]

    (first, perf), (again, same) = looked(), looked()
    assert (first, again, perf) == (1, 0, same)
    assert looked(seed=1)[0] == 1
    with torch.no_grad():
        next(trainer.averaged_fields.trajectory_value.parameters()).mul_(1.1)
    assert looked()[0] == 1


@pytest.mark.usefixtures("little")
@pytest.mark.nightly
def test_no_bound_with_a_divergence_speaks_of_a_controller_that_holds_its_control(monkeypatch):
    few = (*FEW, "certificate.tolerance=0.1", "certificate.stage.steps=20", "certificate.stage.rounds=1")
    trainer = small(*SWING, *WARM, *few, "method=dual")
    fit = lambda: trainer.certify(build_certificate_settings(trainer.config))
    monkeypatch.setattr(TrainedContext, "kind", "value")
    of_value = fit()
    monkeypatch.setattr(TrainedContext, "kind", "trajectories")
    certificate = fit()
    said = certificate.to_dict()
    assert (of_value.held_for, said["held_for"]) == (None, Pace.of(trainer.problem).step)
    assert "holds each control for" in table(said)
    assert "holds each control for" not in table(of_value.to_dict())
    assert certificate.about["lagrangian"] == certificate.about["J"] == "value"
    assert certificate.gap["certified"] is None
    assert certificate.upper == of_value.upper
    for name, bound in said["upper"].items():
        assert bound is None or not bound["counts"], name


@pytest.mark.nightly
def test_auto_stays_out_where_mass_cannot_gather_and_changes_no_bit_there():
    runs = [small(f"warm_start.mode={mode}") for mode in ("off", "auto")]
    before = copy.deepcopy(configured(*SMALL))
    del before["warm_start"]  # as in runs from before there was one
    for trainer in (*runs, older := build_trainer(before)):
        trainer.fit(Observer())
        assert trainer.state.warm is None
    assert differences(state_of(runs[0]), state_of(runs[1])) == differences(state_of(runs[0]), state_of(older)) == []
    auto = lambda *way: small(*way, "method=dual", "warm_start.mode=auto").state.warm
    assert isinstance(auto("problem=cart_pole").source, Trajectories)
    assert isinstance(auto(*SWING).source, GridValues)
    assert isinstance(auto("problem=cart_pole", "problem.noise=1e-3").source, Trajectories)
    assert auto("problem=cart_pole", "problem.control_limit=null") is auto("problem=pendulum") is None


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("method=primal", "warm_start.mode=on"), "warm_start.mode is on, but this method has no V"),
        (("warm_start.mode=maybe",), "warm_start.mode"),
        (("warm_start.trace=1.5",), "warm_start.trace"),
        (("warm_start.pieces=0",), "warm_start.pieces"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(overrides, words):
    with pytest.raises(InputError, match=words):
        small(*overrides)


def logarithmic(dim: int, width: int) -> Logarithmic:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Logarithmic(PeriodicMLP(dim, width=width), 0.1)


def test_a_gradient_that_is_off_counts_over_a_part_of_a_turn():
    problem = PROBLEMS["pendulum"](control_limit=1.0)
    warm = ValueIteration(problem, logarithmic(2, 8), WarmStartSettings("on", 10, 8, 1, 0.5), 0)
    x, all_rows = torch.rand(64, 2), torch.arange(64)
    own = jet(warm.network, x)
    found = lambda gradients: warm._squares(Targets(x, own.value, own.value, gradients), all_rows)
    assert float(found(own.gradient).detach().abs().max()) == 0.0
    torch.testing.assert_close(found(own.gradient + 3.0), torch.full((64,), 2 * (3.0 * GRADIENT_LENGTH) ** 2))


def test_fits_end_at_no_rate_however_trials_turn_out():
    problem = PROBLEMS["pendulum"](control_limit=1.0)
    warm = ValueIteration(problem, logarithmic(2, 8), WarmStartSettings("on", 10, 8, 1, 0.5), 0)
    warm.source.trial_every, warm.trial, rates = 1, Told(*[4.0] * 10), []
    x = torch.rand(64, 2)
    warm.source._found.append(Targets(x, x[:, 0], x[:, 0], torch.zeros_like(x)))
    while not warm.done:
        warm.advance()
        rates.append(warm.optimizer.param_groups[0]["lr"])
    assert rates[0] == 2.5 * 2e-3
    assert rates == sorted(rates, reverse=True)
    assert (len(rates), rates[-1] < 0.1 * rates[0]) == (10, True)


class Told:
    """A trial whose outcomes are known beforehand."""

    def __init__(self, *costs: float) -> None:
        self.costs = list(costs)

    def cost_of_nothing(self) -> float:
        return 5.0

    def cost_of(self, value) -> float:
        return self.costs.pop(0)


def warmed_up_to(*costs: float, rounds: int) -> ValueIteration:
    """The end of one whose trials cost ``costs``."""
    warm = ValueIteration(fresh("circle rho=2"), logarithmic(1, 4), WarmStartSettings("on", rounds, 8, 1, 0.5), 0)
    warm.trial = Told(*costs)
    while not warm.done:
        warm.advance()
    return warm


@pytest.mark.nightly
def test_the_best_controller_is_kept_and_half_of_the_rounds_are_enough_to_find_none():
    warm = warmed_up_to(4.0, 2.0, 6.0, 1.0, rounds=40)
    assert (warm.least, warm.trial.costs, warm.round, warm.found) == (1.0, [], 40, True)
    assert differences(warm.best, warm.average.state_dict()) == []
    earlier = warmed_up_to(6.0, 2.0, 3.0, 3.0, rounds=40)
    assert (earlier.least, earlier.found) == (2.0, True)
    assert differences(earlier.best, earlier.average.state_dict()) != []
    useless = warmed_up_to(6.0, 6.0, rounds=40)
    assert (useless.found, useless.least, useless.round) == (False, 5.0, 20)
    fields = Fields({"value": PeriodicMLP(1, width=16), "trajectory_value": logarithmic(1, 4)})
    before = {name: tensor.clone() for name, tensor in fields.state_dict().items()}
    useless.hand_over([fields])
    assert differences(before, fields.state_dict()) == []
    warm.hand_over([fields])
    assert differences(fields.trajectory_value.state_dict(), warm.best) == []
    x = torch.rand(512, 1)
    wanted = fields.trajectory_value(x)
    assert float((fields.value(x) - wanted).detach().square().mean().sqrt()) < 0.05 * float(wanted.std())


@pytest.mark.usefixtures("little")
@pytest.mark.nightly
@on(NATURAL)
def test_every_system_can_be_warmed_up(problem):
    warm = ValueIteration(problem, logarithmic(problem.dim, 8), WarmStartSettings("on", 1, 8, 2, 0.95), 0)
    assert warm.advance()
    assert warm.done
    assert all(math.isfinite(number) for number in (warm.loss, warm.cost, warm.least))


@pytest.mark.nightly
def test_rounds_lead_to_the_exact_value():
    problem = fresh("manufactured 2-d q=2")
    shift, scale = typical_sizes(problem)[0]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = Logarithmic.of(PeriodicMLP, shift=shift, scale=scale, dim=2, width=32)
    warm = ValueIteration(problem, network, WarmStartSettings("on", 40, 256, 25, 0.95), 0)
    while not warm.done:
        warm.advance()
    x = states(problem, 1024, dtype=torch.float32)
    exact = problem.exact_value(x)
    warm.average.load_state_dict(warm.best)
    error = (warm.average(x) - exact).square().mean().sqrt()
    assert float(error) < 0.05 * float(exact.std())
