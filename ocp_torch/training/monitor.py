"""What a run shows while it goes: a progress bar, the log, and TensorBoard."""

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm.asyncio import tqdm as terminal_bar
from tqdm.auto import tqdm

from ocp_torch.certificate import Certificate, CertificateSettings
from ocp_torch.certificate.report import WIDE
from ocp_torch.certificate.statistics.estimate import known_of
from ocp_torch.control.policies import admissible_density, occupation_density
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers import StepReport
from ocp_torch.training.observer import Observer
from ocp_torch.training.running import RunningEstimates
from ocp_torch.training.trainer import Trainer

log = logging.getLogger(__name__)
# How the names of TensorBoard's files begin.
EVENTS = "events.out.tfevents."
# Two charts in which the bracket closes: by running estimates, and by quick evaluations.
BRACKET = {
    "bracket": {
        "while it trains": ["Multiline", [r"running/.*"]],
        "quick evaluations": ["Multiline", [r"bounds/.*", r"performance/.*"]],
    }
}
TICK = 1.0  # seconds between two movements of the clock
CLOCK = "{desc}: {elapsed}{postfix}"


@torch.no_grad()
def liouville_residual(trainer: Trainer, batch: Samples) -> dict[str, Tensor]:
    """`mean |mu0 - mu - div(a mu + B w) / rho|` on ``batch``, whatever gives `mu`: also where the loss needs no divergences
    (a player does not move yet, the plain saddle) or `mu` is in closed form. Nothing where the problem gives none."""
    problem = trainer.problem
    samples = Samples.of(problem, batch.x) if problem.has_simulator else batch
    if samples.div_a is None or samples.div_B is None:
        return {}
    form = (trainer.objective.occupation, problem, trainer.fields, trainer.constants)
    generator, density = Generator.of(problem, samples), occupation_density(*form)
    *_, residual = generator.liouville_residual(admissible_density(*form), density, problem.still)
    return {"residual_mean_absolute": samples.mean(residual.abs())}


class Monitor(Observer):
    """Progress bar (terminals only), log lines, and TensorBoard scalars in the groups running, bounds, performance, loss, lr,
    gradient_norm, violation and throughput."""

    def __init__(self, folder: Path, trainer: Trainer) -> None:
        warm = trainer.state.warm
        done = trainer.step or (0 if warm is None else warm.round)
        # What a killed start still wrote beyond its last checkpoint is not shown twice.
        self.writer = SummaryWriter(str(folder), purge_step=done + 1 if done else None)
        # disable=None: no bar where the output is not a terminal; a notebook is none, and has bars of its own.
        shown = False if tqdm is not terminal_bar else None
        hidden = shown if trainer.settings.progress else True
        step = trainer.step
        self.writer.add_custom_scalars(BRACKET)
        self.running = RunningEstimates(trainer.problem, trainer.trained, trainer.seed)
        self.bar = tqdm(total=max(trainer.end, step), initial=step, unit="step", dynamic_ncols=True, disable=hidden)
        self.stages = Stages(hidden)
        self._folder = folder
        # Makes the pictures of a quick evaluation, by name; set by the run, which knows how to draw.
        self.pictures: Callable[[Trainer], dict[str, Any]] = lambda _: {}
        self._shown: dict[str, str] = {}
        self._mark = (time.perf_counter(), trainer.samples)

    def __enter__(self) -> "Monitor":
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
        violation = trainer.objective.diagnostics(trainer.fields, batch)
        if "residual_mean_absolute" not in violation and trainer.fields.control_density is not None:
            violation |= liouville_residual(trainer, batch)
        shown: dict[str, dict] = {"loss": report.losses, "gradient_norm": report.gradient_norms, "violation": violation}
        for group, values in {**shown, "lr": trainer.stepper.learning_rates()}.items():
            for name, value in values.items():
                self.writer.add_scalar(f"{group}/{name}", float(value), step)
        if self.running.due(trainer.state.elapsed):
            for name, value in self.running(trainer.constants).items():
                self.writer.add_scalar(f"running/{name}", value, step)
        now, (then, before) = time.perf_counter(), self._mark
        speed = (trainer.samples - before) / max(now - then, 1e-9)
        self._mark = (now, trainer.samples)
        self.writer.add_scalar("throughput/samples_per_second", speed, step)
        self._show({"samples/s": f"{speed:,.0f}"})

    def warmed(self, trainer: Trainer, looked: bool) -> None:
        warm = trainer.state.warm
        assert warm is not None  # who tells of it has one
        self.bar.set_description_str(f"warm start {warm.round}/{warm.settings.rounds}", refresh=False)
        self._show({"loss": f"{warm.loss:.2g}", "cost": f"{warm.cost:.4g}"})
        self.bar.refresh()
        if looked:
            for name in ("loss", "cost"):
                self.writer.add_scalar(f"warm_start/{name}", getattr(warm, name), warm.round)
            log.debug("warm start, round %d: cost %.6g, best %.6g", warm.round, warm.cost, warm.least)
        if warm.done:
            self.bar.set_description_str("")
            log.info(warm.outcome)

    def evaluated(self, trainer: Trainer, certificate: Certificate) -> None:
        record(self.writer, certificate, trainer.step)
        if trainer.step < trainer.end:  # else the end of the run draws them, or the next round
            self._draw(trainer)
        shown = certificate.lower | certificate.upper
        values = {name: f"{e.value:.6f}" for name in ("F_M", "J") if (e := shown.get(name)) is not None}
        gaps = [gap for kind in ("certified", "simulated") if (gap := certificate.gap[kind]) is not None]
        if gaps:
            values["gap"] = f"{100 * min(gaps):.2f}%" if min(gaps) <= WIDE else "wide"
        self._show(values)
        # To train.log, not to the terminal.
        log.debug("step %d: %s", trainer.step, ", ".join(f"{k} {v}" for k, v in values.items()))

    def refined(self, trainer: Trainer, helped: bool | None) -> None:
        if not trainer.settings.newton_steps:
            return
        self.bar.set_description_str("Gauss-Newton steps" if helped is None else "")
        if helped is not None:
            log.debug("step %d: Gauss-Newton steps %s", trainer.step, "refined V" if helped else "did not help")

    def noticed(self, sentence: str) -> None:
        log.warning("warning: %s", sentence)

    def extended(self, trainer: Trainer) -> None:
        self.bar.total = trainer.end
        self._draw(trainer)
        log.info("not good yet: training goes on to step %d, with M = %.4g", trainer.end, trainer.constants.M)

    def stopped(self, trainer: Trainer, why: str, settings: CertificateSettings) -> None:
        """Training stopped, and the certificate is about to be made; says why, and about how long that takes."""
        seconds = trainer.evaluator.expected(settings)
        self.bar.clear()
        rest = f", in about {in_words(seconds)}" if seconds else ""
        log.info("%s; the certificate is next%s", why.rstrip("."), rest)
        self.bar.refresh()
        self.stages.begin(seconds)

    def finish(self, certificate: Certificate, pictures: dict, settings: dict, step: int) -> None:
        """The last points: all numbers of ``certificate``, ``pictures`` by name, and the run's ``settings``, one
        level deep, for the HParams tab; in a file of their own, which replaces one left half-written by a kill."""
        suffix = f".end-{step}"
        for half in self._folder.glob(f"{EVENTS}*{suffix}"):
            half.unlink()
        with SummaryWriter(str(self._folder), filename_suffix=suffix) as writer:
            record(writer, certificate, step)
            for name, pixels in pictures.items():
                writer.add_image(f"fields/{name}", pixels, step, dataformats="HWC")
            allowed = {k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in settings.items()}
            gaps = {f"hparam/{k}": v for k, v in certificate.gap.items() if isinstance(v, float)}
            results = gaps or {"hparam/none": torch.nan}
            for summary in hparams(allowed, results):
                writer.file_writer.add_summary(summary)
            for name, value in results.items():
                writer.add_scalar(name, value)

    def _draw(self, trainer: Trainer) -> None:
        for name, pixels in self.pictures(trainer).items():
            self.writer.add_image(f"fields/{name}", pixels, trainer.step, dataformats="HWC")

    def _show(self, values: dict[str, str]) -> None:
        self._shown |= values
        self.bar.set_postfix(self._shown, refresh=False)


def record(writer: SummaryWriter, certificate: Certificate, step: int) -> None:
    """All numbers of ``certificate`` as scalars at ``step``."""
    bounds, simulated = certificate.lower | certificate.upper, certificate.perf | certificate.baseline
    values = {f"bounds/{name}": estimate.value for name, estimate in known_of(bounds).items()}
    values |= {f"performance/{name}": estimate.value for name, estimate in known_of(simulated).items()}
    parts = {"gap": certificate.gap, "share": certificate.share}
    shares = {f"{group}/{kind}": part[kind] for group, part in parts.items() for kind in ("certified", "simulated")}
    for name, value in {**values, "bounds/exact": certificate.exact, **shares}.items():
        if value is not None:
            writer.add_scalar(name, value, step)


def in_words(seconds: float) -> str:
    """A duration for a user: in seconds, or in minutes from 90 seconds on."""
    return f"{max(1, round(seconds))} s" if seconds < 90.0 else f"{round(seconds / 60.0)} min"


class Stages:
    """A clock with the name of the stage, in terminals; elsewhere, and in the log, a line per stage. Call it with a name."""

    def __init__(self, hidden: bool | None) -> None:
        self._hidden = hidden
        self._clock: Any = None  # the bar, once the first has begun
        self._over = threading.Event()

    def begin(self, seconds: float | None) -> None:
        """The first stage is about to begin, and all of them take about ``seconds``."""
        if self._clock is None:
            self._clock = tqdm(bar_format=CLOCK, dynamic_ncols=True, disable=self._hidden)
            if not self._clock.disable:
                threading.Thread(target=self._tick, daemon=True).start()
        self._clock.set_postfix_str(f"about {in_words(seconds)} in all" if seconds else "", refresh=False)

    def __call__(self, stage: str) -> None:
        self._clock.set_description_str(stage)
        log.log(logging.INFO if self._clock.disable else logging.DEBUG, "%s ...", stage)

    def close(self) -> None:
        self._over.set()
        if self._clock is not None:
            self._clock.close()

    def _tick(self) -> None:
        while not self._over.wait(TICK):
            self._clock.refresh()
