"""The loop: draw samples, step, average; evaluate, log and save on the way. It does not know which method it runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from torch import nn

from ocp_torch.bounds import Bounds
from ocp_torch.certificate import Certificate, CertificateSettings, Run, StageSettings, Trained, certify_fields
from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective
from ocp_torch.problems import Problem
from ocp_torch.samples import Samples
from ocp_torch.steppers import Stepper
from ocp_torch.training.checkpoint import load_checkpoint, save_checkpoint
from ocp_torch.training.settings import TrainerSettings

# What a look at the bounds during training costs: enough for a curve, not for a claim.
QUICK = CertificateSettings(points=1024, replicates=2, trajectories=0, ascents=8, stage=StageSettings(steps=0))


class Trainer:
    """Everything a run is made of. ``average`` is a `torch.optim.swa_utils.AveragedModel` of ``fields``; ``sampler``
    draws states; ``config`` is the configuration all this was built from, as plain data without nulls to fill."""

    def __init__(
        self,
        problem: Problem,
        fields: Fields,
        objective: Objective,
        bounds: Bounds,
        stepper: Stepper,
        average,
        sampler,
        settings: TrainerSettings,
        network: Callable[..., nn.Module],
        seed: int,
        names: tuple[str, str],
        config: dict,
    ) -> None:
        self.problem, self.fields, self.objective, self.bounds = problem, fields, objective, bounds
        self.stepper, self.average, self.sampler, self.settings = stepper, average, sampler, settings
        self.network, self.seed, self.names, self.config = network, seed, names, config
        self.step, self.samples, self.seconds = 0, 0, 0.0

    @property
    def averaged_fields(self) -> Fields:
        """The fields that are handed out."""
        return self.average.module

    @property
    def run(self) -> Run:
        """Who and where this run is, for its certificate."""
        problem, method = self.names
        return Run(problem, method, self.seed, self.step, self.samples, self.seconds)

    def draw(self) -> Samples:
        """The next batch of training samples, on the run's device."""
        x = self.sampler.draw(self.settings.batch).to(self.settings.torch_device)
        return Samples.of(self.problem, x, divergences=self.objective.needs_divergences)

    def fit(self, monitor, checkpoint: Path | None = None) -> None:
        """Train up to ``settings.steps``; save to ``checkpoint`` on the way and at the end."""
        settings = self.settings
        while self.step < settings.steps:
            started = time.perf_counter()
            self.objective.progress = self.step / settings.steps
            report = self.stepper.step(self.draw, lambda: self.average.update_parameters(self.fields))
            self.step += 1
            self.samples += report.samples
            self.seconds += time.perf_counter() - started
            last = self.step == settings.steps
            monitor.stepped(self, report, log=self.step % settings.log_every == 0 or last)
            if settings.evaluate_every and self.step % settings.evaluate_every == 0 and not last:
                monitor.evaluated(self, self.certify(QUICK))
            due = settings.checkpoint_every and self.step % settings.checkpoint_every == 0
            if checkpoint is not None and (due or last):
                save_checkpoint(checkpoint, self.state_dict())

    def certify(self, settings: CertificateSettings) -> Certificate:
        """The certificate of the averaged fields as they stand."""
        trained = Trained(self.averaged_fields, self.objective.occupation, self.network)
        return certify_fields(self.problem, trained, self.bounds, settings, self.run)

    def state_dict(self) -> dict:
        """Everything needed to go on exactly."""
        return {
            "step": self.step,
            "samples": self.samples,
            "seconds": self.seconds,
            "fields": self.fields.state_dict(),
            "average": self.average.state_dict(),
            "stepper": self.stepper.state_dict(),
            "sampler": self.sampler.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        self.step, self.samples, self.seconds = state["step"], state["samples"], state["seconds"]
        self.fields.load_state_dict(state["fields"])
        self.average.load_state_dict(state["average"])
        self.stepper.load_state_dict(state["stepper"])
        self.sampler.load_state_dict(state["sampler"])

    def resume(self, checkpoint: Path) -> None:
        """Go on from ``checkpoint`` exactly where it was saved."""
        self.load_state_dict(load_checkpoint(checkpoint))
