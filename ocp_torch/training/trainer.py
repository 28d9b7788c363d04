"""The loop: draw samples, step, average; evaluate, log and save on the way. It does not know which method it runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from torch import nn

from ocp_torch.bounds import Bounds
from ocp_torch.certificate import Certificate, CertificateSettings, Run, StageSettings, Trained, certify_fields, raised
from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective
from ocp_torch.problems import Problem
from ocp_torch.samples import Samples
from ocp_torch.steppers import Stepper
from ocp_torch.training.checkpoint import load_checkpoint, save_checkpoint
from ocp_torch.training.settings import TrainerSettings

# What a look at the bounds during training costs: enough for a curve, not for a claim.
QUICK = CertificateSettings(
    points=2048, replicates=2, trajectories=32, ascents=8, occupation_states=0, stage=StageSettings(steps=0)
)


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
        self.step, self.round, self.samples, self.seconds = 0, 0, 0, 0.0

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

    @property
    def end(self) -> int:
        """The step at which the present round ends: round `k` (from 0) is `2^k` times as long as the first."""
        return self.settings.steps * (2 ** (self.round + 1) - 1)

    @property
    def progress(self) -> float:
        """The part of the present round that is done."""
        length = self.settings.steps * 2**self.round
        return 1.0 - (self.end - self.step) / length

    def fit(self, monitor, checkpoint: Path | None = None) -> None:
        """Train for the first round, and for further ones as `settings` allow; save to ``checkpoint`` on the way."""
        while True:
            while self.step < self.end:
                self._advance(monitor, checkpoint)
            if not self._wants_another_round():
                break
            self.round += 1
            monitor.extended(self)
        if checkpoint is not None:
            save_checkpoint(checkpoint, self.state_dict())

    def _advance(self, monitor, checkpoint: Path | None) -> None:
        """One step, and what is due after it."""
        settings = self.settings
        started = time.perf_counter()
        self.objective.progress = self.progress
        report = self.stepper.step(self.draw, lambda: self.average.update_parameters(self.fields))
        self.step += 1
        self.samples += report.samples
        self.seconds += time.perf_counter() - started
        last = self.step == self.end
        monitor.stepped(self, report, log=self.step % settings.log_every == 0 or last)
        if settings.evaluate_every and self.step % settings.evaluate_every == 0 and not last:
            monitor.evaluated(self, self.certify(QUICK))
        if checkpoint is not None and settings.checkpoint_every and self.step % settings.checkpoint_every == 0:
            save_checkpoint(checkpoint, self.state_dict())

    def _wants_another_round(self) -> bool:
        """Whether rounds are left and the gap is not good yet; never without a lower bound to measure it by.

        An `M` that was a guess and turned out too small is raised for the next round.
        """
        if self.round + 1 >= self.settings.rounds or self.fields.value is None:
            return False
        certificate = self.certify(replace(QUICK, occupation_states=CertificateSettings.occupation_states))
        better = raised(self.bounds, certificate.assumptions.estimated_sup_occupation)
        if better.M > self.bounds.M:
            self._use(better)
            return True
        gap = certificate.gap["simulated"]
        return gap is None or gap > self.settings.good_gap

    def _use(self, bounds: Bounds) -> None:
        self.bounds = self.objective.bounds = bounds

    def certify(self, settings: CertificateSettings) -> Certificate:
        """The certificate of the averaged fields as they stand."""
        trained = Trained(self.averaged_fields, self.objective.occupation, self.network)
        return certify_fields(self.problem, trained, self.bounds, settings, self.run)

    def state_dict(self) -> dict:
        """Everything needed to go on exactly."""
        return {
            "step": self.step,
            "round": self.round,
            "M": self.bounds.M,
            "samples": self.samples,
            "seconds": self.seconds,
            "fields": self.fields.state_dict(),
            "average": self.average.state_dict(),
            "stepper": self.stepper.state_dict(),
            "sampler": self.sampler.state_dict(),
        }

    def load_state_dict(self, state: dict) -> None:
        self.step, self.round = state["step"], state["round"]
        self.samples, self.seconds = state["samples"], state["seconds"]
        self._use(replace(self.bounds, M=state["M"]))
        self.fields.load_state_dict(state["fields"])
        self.average.load_state_dict(state["average"])
        self.stepper.load_state_dict(state["stepper"])
        self.sampler.load_state_dict(state["sampler"])

    def resume(self, checkpoint: Path) -> None:
        """Go on from ``checkpoint`` exactly where it was saved."""
        self.load_state_dict(load_checkpoint(checkpoint))
