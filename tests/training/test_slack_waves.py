"""Waves that V lacks are found in its slack, all and no others; networks take them without becoming another function."""

import pytest
import torch

from ocp_torch.fields import VALUE, Fields, PeriodicMLP
from ocp_torch.problems import Manufactured
from ocp_torch.runs.build import build_trainer
from ocp_torch.training.observer import Observer
from ocp_torch.training.slack_waves import add_waves, missed_waves
from support.bits import differences
from support.small import configured, state_of

pytestmark = pytest.mark.usefixtures("quick_composition")


def network(dim: int, **options) -> PeriodicMLP:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return PeriodicMLP(dim, **{"modes": 2, "waves": 6, "width": 12, "depth": 2, **options}).double()


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("outputs", [None, 2])
def test_a_network_with_new_waves_is_the_same_function_and_can_learn_them(gated, outputs):
    net = network(3, gated=gated, outputs=outputs)
    net.embedding.mix(torch.tensor([[1.0, 1.0, 0.0]]))
    x = torch.rand(50, 3, dtype=torch.float64)
    before, new = net(x), torch.tensor([[0.0, 1.0, -2.0], [3.0, 0.0, 0.0]])
    net.add_waves(new)
    assert torch.allclose(net(x), before, atol=1e-14)
    assert net.embedding.mixed[:4].tolist() == [[1.0, 1.0, 0.0], *new.tolist(), [0.0, 0.0, 0.0]]
    net(x).square().sum().backward()
    first = net.body[0].linear if gated else net.body[0]
    slopes = first.weight.grad.abs().sum(dim=0).reshape(2, -1)  # of cosines and of sines: 6 modes, 6 waves
    assert (slopes[:, 7:9] > 0.0).all()
    assert (slopes[1, 9:] == 0.0).all()


def test_more_waves_than_there_is_room_for_are_left_out():
    net = network(2, waves=2)
    net.add_waves(torch.tensor([[1.0, 1.0], [1.0, 2.0], [2.0, 1.0]]))
    net.add_waves(torch.tensor([[2.0, 2.0]]))
    assert net.embedding.mixed.tolist() == [[1.0, 1.0], [1.0, 2.0]]
    assert net.embedding.free == []


class Lacking(torch.nn.Module):
    """`V*` of a manufactured problem without the terms ``left_out``, and an embedding that has the waves of the others."""

    def __init__(self, problem: Manufactured, left_out: list[int]) -> None:
        super().__init__()
        self.problem, self.left_out = problem, left_out
        self.embedding = network(problem.dim, waves=24).embedding
        kept = [i for i in range(len(problem.V0.waves)) if i not in left_out]
        self.embedding.mix(problem.V0.waves[kept])
        self.precision = torch.nn.Parameter(torch.zeros((), dtype=torch.float64))  # of the states it is asked at

    def forward(self, x):
        V0 = self.problem.V0
        missing = sum(
            V0.amplitudes[i] * (2.0 * torch.pi * (x @ V0.waves[i]) + V0.phases[i]).cos() for i in self.left_out
        )
        return self.problem.exact_value(x) - missing


@pytest.mark.parametrize("noise", [0.0, pytest.param(0.02, marks=pytest.mark.nightly)])
def test_the_terms_that_are_missing_are_found_and_none_that_is_there(noise):
    problem = Manufactured(dim=5, noise=noise, seed=2)
    left_out = [1, 4, 7]
    found = missed_waves(problem, Fields({VALUE: Lacking(problem, left_out)}))
    both = lambda waves: {tuple(k) for k in waves.tolist()} | {tuple(-e for e in k) for k in waves.tolist()}
    kept = [i for i in range(len(problem.V0.waves)) if i not in left_out]
    assert both(problem.V0.waves[left_out]) <= both(found)
    assert not both(found) & both(problem.V0.waves[kept])


@pytest.mark.nightly
def test_terms_of_many_coordinates_are_found_when_they_are_asked_for():
    problem, left_out = Manufactured(dim=10, interaction=7, drift=0.0, seed=2), [0, 3]
    fields = Fields({VALUE: Lacking(problem, left_out)})
    both = lambda waves: {tuple(k) for k in waves.tolist()} | {tuple(-e for e in k) for k in waves.tolist()}
    wanted = both(problem.V0.waves[left_out])
    assert not wanted & both(missed_waves(problem, fields))
    assert wanted <= both(missed_waves(problem, fields, coupled=True))


def test_the_exact_value_lacks_nothing_and_without_room_or_a_value_nothing_is_sought():
    problem = Manufactured(dim=5, seed=2)
    assert len(missed_waves(problem, Fields({VALUE: Lacking(problem, [])}))) == 0
    assert len(missed_waves(problem, Fields({VALUE: network(5, waves=0)}))) == 0
    assert len(missed_waves(problem, Fields({"control_density": network(5)}))) == 0


@pytest.mark.parametrize("method", ["dual", "pd"])
def test_a_run_takes_them_and_goes_on_from_any_step_to_the_same_bits(method, monkeypatch, tmp_path):
    monkeypatch.setattr("ocp_torch.training.slack_waves.WAVE_SEARCH_STEPS", (3, 5))
    problem = ("problem=manufactured", "problem.dim=2", f"method={method}", "model.waves=24", "model.width=16")
    config = configured("trainer.device=cpu", "trainer.steps=7", "trainer.rounds=1", "trainer.batch=64", *problem)

    class Saving(Observer):
        def stepped(self, trainer, report, log):
            trainer.save(tmp_path / f"{trainer.step}.pt")

    whole = build_trainer(config)
    at_first = [len(n.embedding.free) for n in whole.fields.networks.values()]
    whole.fit(Saving())
    now = [len(n.embedding.free) for n in whole.fields.networks.values()]
    assert all(b < a for a, b in zip(at_first, now, strict=True))
    assert torch.equal(whole.averaged_fields.value.embedding.mixed, whole.fields.value.embedding.mixed)
    for step in (2, 3, 4):  # before they are sought for the first time, just before, and after
        resumed = build_trainer(config)
        resumed.resume(tmp_path / f"{step}.pt")
        resumed.fit(Observer())
        assert differences(state_of(resumed), state_of(whole)) == []


def test_only_networks_of_ours_are_given_any():
    class Own(torch.nn.Linear):
        pass

    own, ours = Own(2, 1), network(2)
    add_waves(Fields({"own": own, VALUE: ours}), torch.tensor([[1.0, 1.0]]))
    assert len(ours.embedding.free) == 5
