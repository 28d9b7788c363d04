"""Second cores: copies of the process leave a certificate as it is, and no simulation is made twice."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from ocp_torch.certificate import Run, StageSettings, Trained, TrainedContext, certify_fields
from ocp_torch.certificate.contexts import trained as trained_context
from ocp_torch.certificate.lower import shifted
from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated import candidates
from ocp_torch.compute import background, threads
from ocp_torch.compute.background import BackgroundResult
from ocp_torch.errors import ProblemError
from ocp_torch.fields import SUBSOLUTION, Fields, PeriodicMLP, Subsolution
from ocp_torch.maths.peaks import Peaks
from ocp_torch.problems import Circle, Simulator
from ocp_torch.problems.constants import resolve_constants
from ocp_torch.training.evaluator import QuickSettings
from support import zoo

SMALL = dict(points=256, replicates=2, trajectories=4, ascents=2, occupation_states=0, mollify=True, tolerance=0.1)
SETTINGS = CertificateSettings(**SMALL, stage=StageSettings(steps=20, rounds=1))  # type: ignore[arg-type]
RUN = Run("any", "dual")


@pytest.fixture
def always_trained_on(monkeypatch):
    """`V` is trained on for the bound, shortly, whatever that promises."""
    for plan in ("PLAN", "NOISY_PLAN"):
        monkeypatch.setattr(f"ocp_torch.certificate.lower.tightened.{plan}", (1000.0, 30, 1e-3))
    for least in ("LEAST_PROMISE", "NOISY_LEAST_PROMISE"):
        monkeypatch.setattr(f"ocp_torch.certificate.lower.sampled.{least}", 0.0)


def trained_of(problem) -> Trained:
    torch.manual_seed(0)
    make = partial(PeriodicMLP, width=8, depth=2, modes=1)
    return Trained(Fields({"value": make(problem.dim)}), None, make)


def begun_with(cores: int, monkeypatch) -> list[bool]:
    """Have so many ``cores``; returns whether each job that is begun from then on is begun in a copy."""
    copies: list[bool] = []
    begin = BackgroundResult.begin
    monkeypatch.setattr(threads, "cores", lambda: cores - threads.taken)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    noted = lambda job: (begin(job), copies.append(job._copy is not None))[0]
    monkeypatch.setattr(BackgroundResult, "begin", noted)
    return copies


def said(problem, trained: Trained, cores: int) -> tuple[dict, list[bool]]:
    """The certificate made on so many ``cores``, and which of its jobs were done in copies."""
    with pytest.MonkeyPatch.context() as patch:
        copies = begun_with(cores, patch)
        found = certify_fields(problem, trained, resolve_constants(problem), SETTINGS, RUN).to_dict()
    assert threads.taken == 0
    return found, copies


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["kuramoto n=3", "noisy 1-d"])
def test_more_cores_give_the_same_certificate(name, always_trained_on):
    problem = zoo.build(name)
    trained = trained_of(problem)
    alone, copies = said(problem, trained, 1)
    assert copies == [False, False]
    assert said(problem, trained, 2) == (alone, [True, False])
    assert said(problem, trained, 4) == (alone, [True, True])  # of the four cores one copy takes two, the other one


def test_on_two_cores_a_certificate_is_bitwise_that_of_one():
    alone, copies = said(Circle(), trained_of(Circle()), 1)
    assert not any(copies)
    both, copies = said(Circle(), trained_of(Circle()), 2)
    assert copies[0]
    assert both == alone


def test_where_copies_fail_the_certificate_is_the_same(monkeypatch):
    alone, _ = said(Circle(), trained_of(Circle()), 1)
    monkeypatch.setattr(background, "_leave", lambda parent: 1 / 0)
    both, copies = said(Circle(), trained_of(Circle()), 2)
    assert copies[0]
    assert both == alone


def test_what_was_simulated_beside_training_for_the_bound_is_not_simulated_again(always_trained_on, monkeypatch):
    problem, policies = Circle(), []
    simulation = candidates.Simulation
    counted = lambda problem, policy, **how: (policies.append(type(policy)), simulation(problem, policy, **how))[1]
    monkeypatch.setattr(candidates, "Simulation", counted)
    constants = resolve_constants(problem)
    trained = trained_of(problem)
    W = TrainedContext(problem, constants, SETTINGS, RUN, trained=trained).tightened
    assert W is not None
    before = len(policies)
    assert before == 2  # the controller of V, and none
    both = Fields({**trained.fields.networks, SUBSOLUTION: W.float()})
    known = Trained(both, None, trained.network, memory=trained.memory)
    found = certify_fields(problem, known, constants, SETTINGS, RUN)
    assert len(policies) == before + 2  # that of W, and none
    fresh = Trained(both, None, trained.network)
    assert found.to_dict() == certify_fields(problem, fresh, constants, SETTINGS, RUN).to_dict()
    assert len(policies) == before + 2 + 3


@pytest.mark.parametrize("known", [True, False])
def test_where_that_of_V_is_the_best_known_the_controller_of_V_trained_on_is_simulated_at_length_at_once(
    known, monkeypatch
):
    problem, trained, efforts = Circle(), trained_of(Circle()), []
    simulation, settings = candidates.Simulation, replace(SETTINGS, trajectories=candidates.CHEAP)
    constants = resolve_constants(problem)
    found = TrainedContext(problem, constants, settings, RUN, trained=trained).simulated[0]
    noted = lambda *given, **how: (efforts.append(how["trajectories"]), simulation(*given, **how))[1]
    monkeypatch.setattr(candidates, "Simulation", noted)
    monkeypatch.setattr(TrainedContext, "remembered", found if known else {})
    both = Fields({**trained.fields.networks, SUBSOLUTION: Subsolution(trained.fields.value, torch.zeros(0, 1))})
    context = TrainedContext(problem, constants, settings, RUN, trained=replace(trained, fields=both))
    assert context.expected == (SUBSOLUTION if known else None)
    assert context.looked.keys() == {"value", SUBSOLUTION}
    roughly = candidates.CHEAP // candidates.BASELINE_PART
    assert efforts == ([candidates.CHEAP] if known else [roughly, roughly])


@pytest.mark.parametrize(("settings", "seeks"), [(QuickSettings(**SMALL), False), (SETTINGS, True)])  # type: ignore[arg-type]
def test_steep_places_are_searched_for_claims_alone(settings, seeks, monkeypatch):
    searched = []
    empty = lambda *how: (searched.append(how), Peaks(torch.zeros(0, 1, dtype=torch.float64), 0))[1]
    monkeypatch.setattr(shifted, "steep_peaks", empty)
    certify_fields(Circle(), trained_of(Circle()), resolve_constants(Circle()), settings, RUN)
    assert bool(searched) == seeks


def test_a_function_that_is_not_finite_is_told_before_anything_is_simulated():
    class Hole(Circle):
        def initial_density(self, x):
            near = (x[:, 0].remainder(1.0) - 0.3).abs() < 0.05
            return torch.where(near, torch.nan, super().initial_density(x))

    constants = resolve_constants(Circle())
    context = TrainedContext(Hole(), constants, SETTINGS, RUN, trained=trained_of(Circle()))
    with pytest.raises(ProblemError, match="initial_density is not finite at x"):
        _ = context.tightened


def test_what_is_remembered_of_other_networks_or_another_effort_is_made_anew():
    problem, trained = Circle(), trained_of(Circle())
    constants = resolve_constants(problem)
    first = TrainedContext(problem, constants, SETTINGS, RUN, trained=trained)
    assert first.simulated[0].keys() == {"value"}
    again = TrainedContext(problem, constants, SETTINGS, RUN, trained=trained)
    assert again.remembered["value"] is first.simulated[0]["value"]
    quick = QuickSettings(**SMALL, stage=SETTINGS.stage)  # type: ignore[arg-type]
    assert TrainedContext(problem, constants, quick, RUN, trained=trained).remembered == {}
    for numbers in (trained.fields.parameters(), trained.fields.buffers()):
        with torch.no_grad():
            changed = next(numbers)
            changed.add_(1e-3)
            assert TrainedContext(problem, constants, SETTINGS, RUN, trained=trained).remembered == {}
            changed.sub_(1e-3)


def test_the_fit_is_to_the_best_controller_whichever_led_at_first(monkeypatch):
    problem, trained = Circle(), trained_of(Circle())
    torch.manual_seed(1)
    W = PeriodicMLP(problem.dim, width=8, depth=2, modes=1)
    both = Trained(
        Fields({**trained.fields.networks, SUBSOLUTION: Subsolution(W, torch.zeros(0, 1))}), None, trained.network
    )
    fitted = []
    fit = trained_context.fit_closed_loop
    monkeypatch.setattr(trained_context, "fit_closed_loop", lambda *how: (fitted.append(how[1].value), fit(*how))[1])
    context = TrainedContext(problem, resolve_constants(problem), SETTINGS, RUN, trained=both)
    best = context.followed
    other = ({"value", "subsolution"} - {best}).pop()
    monkeypatch.setattr(TrainedContext, "_best_of", lambda self, names, at_first=False: other if at_first else best)
    with context.ahead():
        assert context.fitted is not None
    assert fitted == [getattr(both.fields, best)]


def test_a_strangers_functions_are_not_called_from_two_threads_and_a_simulator_not_in_a_copy_of_the_process():
    class Own(Circle):
        pass

    simulator = Simulator(lambda x: (0.0, None, np.eye(1)), dim=1)
    assert [problem.concurrent for problem in (Circle(), Own(), simulator)] == [True, False, False]
    assert [problem.copyable for problem in (Circle(), Own(), simulator)] == [True, True, False]
