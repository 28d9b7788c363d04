"""What a run shows while it goes: a progress bar, the log, and TensorBoard."""

from __future__ import annotations

import logging
import time
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm

from ocp_torch.certificate import Certificate, CertificateSettings
from ocp_torch.control.policies import admissible_density, occupation_density
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers import StepReport
from ocp_torch.training.observer import Silent
from ocp_torch.training.stages import Stages, in_words, rough_seconds
from ocp_torch.training.trainer import Trainer

log = logging.getLogger(__name__)
# How the names of TensorBoard's files begin.
EVENTS = "events.out.tfevents."


@torch.no_grad()
def liouville_residual(trainer: Trainer, batch: Samples) -> dict[str, Tensor]:
    """`mean |mu0 - mu - div(a mu + B w) / rho|` on ``batch``, whatever gives `mu`: also where the loss needs no divergences
    (a player does not move yet, the plain saddle) or `mu` is in closed form. Nothing where the problem gives none."""
    problem, fields = trainer.problem, trainer.fields
    samples = Samples.of(problem, batch.x) if problem.has_simulator else batch
    if samples.div_a is None or samples.div_B is None:
        return {}
    form = (trainer.objective.occupation, problem, fields, trainer.constants)
    generator = Generator.of(problem, samples)
    _, inflow = generator.control_inflow(admissible_density(*form))
    density = occupation_density(*form)
    if problem.still:
        outflow = density(samples.x)
    else:
        mu, drifted, _ = generator.drift_flux(density)
        outflow = mu + drifted / problem.discount
    return {"residual_mean_absolute": samples.mean((inflow - outflow).abs())}


class Monitor(Silent):
    """Progress bar (terminals only), log lines, and TensorBoard scalars in the groups bounds, performance, loss, lr,
    gradient_norm, violation and throughput."""

    def __init__(self, folder: Path, trainer: Trainer) -> None:
        done = trainer.step
        # What a killed start still wrote beyond its last checkpoint is not shown twice.
        self.writer = SummaryWriter(str(folder), purge_step=done + 1 if done else None)
        # disable=None: no bar where the output is not a terminal.
        hidden = None if trainer.settings.progress else True
        options = dict(unit="step", dynamic_ncols=True, disable=hidden)
        self.bar = tqdm(total=max(trainer.end, done), initial=done, **options)
        self.stages = Stages(hidden)
        self._folder = folder
        self._shown: dict[str, str] = {}
        self._mark = (time.perf_counter(), trainer.samples)

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *_) -> None:
        self.stages.close()
        self.bar.close()
        self.writer.close()

    def stepped(self, trainer: Trainer, report: StepReport, log: bool) -> None:
        self.bar.update(trainer.step - self.bar.n)
        if not log:
            return
        step, batch = trainer.step, report.batches[-1]
        for player in report.losses:
            self.writer.add_scalar(f"loss/{player}", float(report.losses[player]), step)
            self.writer.add_scalar(f"gradient_norm/{player}", float(report.gradient_norms[player]), step)
        shown = trainer.objective.diagnostics(trainer.fields, batch)
        if "residual_mean_absolute" not in shown and trainer.fields.control_density is not None:
            shown |= liouville_residual(trainer, batch)
        for name, value in shown.items():
            self.writer.add_scalar(f"violation/{name}", float(value), step)
        for player, rate in trainer.stepper.learning_rates().items():
            self.writer.add_scalar(f"lr/{player}", rate, step)
        now, (then, before) = time.perf_counter(), self._mark
        speed = (trainer.samples - before) / max(now - then, 1e-9)
        self._mark = (now, trainer.samples)
        self.writer.add_scalar("throughput/samples_per_second", speed, step)
        self._show(**{"samples/s": f"{speed:,.0f}"})

    def evaluated(self, trainer: Trainer, certificate: Certificate) -> None:
        record(self.writer, certificate, trainer.step)
        shown = {name: e for name, e in {**certificate.lower, **certificate.upper}.items() if e is not None}
        values: dict[str, str] = {name: f"{shown[name].value:.6f}" for name in ("F_M", "J") if name in shown}
        gaps = [gap for gap in (certificate.gap["certified"], certificate.gap["simulated"]) if gap is not None]
        if gaps:
            values["gap"] = f"{100 * min(gaps):.2f}%"
        self._show(**values)
        # To train.log, not to the terminal.
        log.debug("step %d: %s", trainer.step, ", ".join(f"{k} {v}" for k, v in values.items()))

    def noticed(self, sentence: str) -> None:
        log.warning("warning: %s", sentence)

    def extended(self, trainer: Trainer) -> None:
        self.bar.total = trainer.end
        log.info("not good yet: training goes on to step %d, with M = %.4g", trainer.end, trainer.constants.M)

    def stopped(self, trainer: Trainer, why: str, settings: CertificateSettings) -> None:
        """Training stopped, and the certificate is about to be made; says why, and about how long that takes."""
        per_step = trainer.state.seconds / max(trainer.step, 1)
        seconds = rough_seconds(trainer.evaluator.seconds, per_step, settings.stage.steps)
        self.bar.clear()
        rest = f", in about {in_words(seconds)}" if seconds else ""
        log.info("%s; the certificate is next%s", why.rstrip("."), rest)
        self.bar.refresh()
        self.stages.begin(seconds)

    def certifying(self, stage: str) -> None:
        """A stage of the certificate begins."""
        self.stages(f"certifying: {stage}")

    def finish(self, certificate: Certificate, figures: dict, settings: dict, step: int) -> None:
        """The last points: all numbers of ``certificate``, the Matplotlib ``figures`` by name, and the run's ``settings``,
        one level deep, for the HParams tab; in a file of their own, which replaces one left half-written by a kill."""
        suffix = f".end-{step}"
        for half in self._folder.glob(f"{EVENTS}*{suffix}"):
            half.unlink()
        with SummaryWriter(str(self._folder), filename_suffix=suffix) as writer:
            record(writer, certificate, step)
            for name, figure in figures.items():
                writer.add_figure(f"fields/{name}", figure, step, close=False)
            allowed = {k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in settings.items()}
            gaps = {f"hparam/{k}": v for k, v in certificate.gap.items() if isinstance(v, float)}
            results = gaps or {"hparam/none": torch.nan}
            for summary in hparams(allowed, results):
                writer.file_writer.add_summary(summary)
            for name, value in results.items():
                writer.add_scalar(name, value)

    def _show(self, **values: str) -> None:
        self._shown |= values
        self.bar.set_postfix(self._shown, refresh=False)


def record(writer: SummaryWriter, certificate: Certificate, step: int) -> None:
    """All numbers of ``certificate`` as scalars at ``step``."""
    scalars = {f"bounds/{n}": e for g in ("lower", "upper") for n, e in getattr(certificate, g).items()}
    scalars |= {f"performance/{n}": e for g in ("perf", "baseline") for n, e in getattr(certificate, g).items()}
    for name, estimate in scalars.items():
        if estimate is not None and estimate.finite:
            writer.add_scalar(name, estimate.value, step)
    if certificate.exact is not None:
        writer.add_scalar("bounds/exact", certificate.exact, step)
    for group in ("gap", "share"):
        for kind in ("certified", "simulated"):
            value = getattr(certificate, group)[kind]
            if value is not None:
                writer.add_scalar(f"{group}/{kind}", value, step)
