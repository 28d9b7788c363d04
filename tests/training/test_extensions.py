"""A stepper and an architecture of one's own are a class, and a line in the list of them."""

import json

import pytest
import torch
from torch import nn

from ocp_torch import load_controller
from ocp_torch.errors import InputError
from ocp_torch.fields import MODELS
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.runs.run import run_to_end
from ocp_torch.steppers import STEPPERS, Stepper, StepReport
from ocp_torch.training.monitor import Observer
from support.bits import differences
from support.small import SMALL, configured, small, state_of

pytestmark = pytest.mark.usefixtures("quick_composition", "cheap_looks")


class Alternating(Stepper):
    """Every player moves on a batch of its own, the later ones having seen the earlier ones move."""

    draws = 2

    def step(self, batches, phase) -> StepReport:
        losses, norms, counted = {}, {}, self._parameters()
        for batch, player in zip(batches, self.objective.players, strict=True):
            all_losses, all_norms = self._differentiate(batch, phase)
            if player in all_losses:
                losses[player], norms[player] = all_losses[player], all_norms[player]
                self._update([player])
        return StepReport(losses, norms, batches, counted)


def test_a_stepper_of_ones_own_trains_averages_and_resumes(monkeypatch, tmp_path):
    monkeypatch.setitem(STEPPERS, "alternating", Alternating)
    made = lambda: small("method=pd", "stepper.name=alternating", "trainer.steps=10", "trainer.checkpoint_every=6")
    whole, start = made(), made().fields
    whole.fit(Observer(), tmp_path / "last.pt")
    assert whole.samples == 2 * 16 * 10
    for name, network in whole.fields.networks.items():
        assert differences(network.state_dict(), start.networks[name].state_dict()) != []
    assert whole.state.average.n_averaged == 10
    resumed = made()
    resumed.resume(tmp_path / "last-1.pt")
    assert resumed.step == 6
    resumed.fit(Observer())
    assert differences(state_of(resumed), state_of(whole)) == []


class Ripples(nn.Module):
    """A sum of ``count`` waves at whole frequencies drawn at the start."""

    def __init__(self, dim, outputs=None, count=4, shift=0.0, scale=1.0) -> None:
        super().__init__()
        self.scalar = outputs is None
        self.register_buffer("waves", torch.randint(-2, 3, (count, dim)).float())
        self.phases = nn.Parameter(torch.zeros(count))
        self.head = nn.Linear(count, 1 if outputs is None else outputs)
        self.register_buffer("shift", torch.tensor(float(shift)))
        self.register_buffer("scale", torch.tensor(float(scale)))

    @classmethod
    def defaults(cls, dim, worst_state=False, noisy=False) -> dict:
        return {"count": (8 if worst_state else 5) + dim}

    def forward(self, x):
        out = self.shift + self.scale * 0.1 * self.head((2 * torch.pi * x @ self.waves.T + self.phases).cos())
        return out.squeeze(-1) if self.scalar else out


@pytest.mark.nightly
@pytest.mark.parametrize(("problem", "count"), [("circle", 6), pytest.param("arm", 10, marks=pytest.mark.nightly)])
def test_an_architecture_of_ones_own_brings_its_sizes_and_leaves_all_that_a_run_leaves(
    problem, count, monkeypatch, tmp_path
):
    monkeypatch.setitem(MODELS, "ripples", Ripples)
    config = configured(*SMALL[:1], *SMALL[2:], f"problem={problem}", "method=pd", "trainer.steps=4")
    config["model"] = {"name": "ripples", "count": None}
    trainer = build_trainer(config)
    assert trainer.config["model"] == {"name": "ripples", "count": count}
    certificate = run_to_end(trainer, build_certificate_settings(trainer.config), tmp_path)
    assert json.loads((tmp_path / "certificate.json").read_text())["step"] == 4
    assert certificate.lower["shifted"] is not None
    loaded = load_controller(tmp_path / "controller.safetensors")
    assert isinstance(loaded.fields.value, Ripples)
    again = build_trainer(config)
    again.resume(tmp_path / "checkpoints" / "last.pt")
    assert again.step == 4


def test_an_architecture_nobody_knows_is_refused_by_name():
    config = configured(*SMALL)
    with pytest.raises(InputError, match=rf"model\.name is 'nobodys', but must be one of {', '.join(sorted(MODELS))}"):
        build_trainer({**config, "model": {"name": "nobodys"}})
