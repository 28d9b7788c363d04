"""One run in its folder: built from a configuration, begun or resumed, trained, and finished."""

import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from torch import Tensor

from ocp_torch.certificate import Certificate, CertificateSettings, table
from ocp_torch.certificate.settings import require_possible
from ocp_torch.control.controller import Controller
from ocp_torch.errors import InputError, StorageError, require_integer
from ocp_torch.fields import Fields
from ocp_torch.files.limits import require_held
from ocp_torch.files.reading import require_unlinked
from ocp_torch.files.storage import only_writer, sweep_temporaries
from ocp_torch.problems import Problem
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.runs.configuration import keep_configuration, load_state, starts
from ocp_torch.runs.finish import (
    complete,
    failure_of,
    glimpse,
    hand_out,
    missing,
    salvaged,
    unless_it_failed,
    with_warnings,
)
from ocp_torch.runs.metrics.trial import write_metrics
from ocp_torch.runs.report.report import REPORT, write_report
from ocp_torch.runs.resume import filled_from, require_same_run, result_of
from ocp_torch.training.checkpoint import LAST
from ocp_torch.training.monitor import Monitor
from ocp_torch.training.observer import Observer
from ocp_torch.training.state import seed_generators
from ocp_torch.training.stopping import TARGET_GAP, Signals, postpone
from ocp_torch.training.trainer import Trainer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingRun:
    """A run that is ready to go: its trainer, fresh or as its checkpoint left it; for a resumed run also the ``state`` it was
    given, and a sentence on each newer checkpoint that is damaged."""

    config: dict
    trainer: Trainer
    settings: CertificateSettings
    state: dict | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ending:
    """The results of a run: ``controller`` with its ``certificate``, ``metrics`` where its problem has some; and, where a
    loss or the problem ``failed``, a sentence with the reason."""

    certificate: Certificate
    controller: Controller
    metrics: dict | None
    failed: str | None


def training_run(config: dict, problem: Problem | None = None) -> TrainingRun:
    """The run that the plain ``config`` describes, at the checkpoint that its ``resume`` names, which is read once;
    ``problem`` is the problem, where it has been made already.

    Raises `InputError` for any wrong field, damaged file, or change that a resume cannot make; writes nothing.
    """
    own = {name: value for name, value in config.items() if name != "resume"}
    state, notes = None, list[str]()
    if config.get("resume") is not None:
        state, checkpoint, notes = load_state(Path(config["resume"]))
        if not isinstance(state, dict) or not isinstance(state.get("config"), dict):
            raise InputError(f"{checkpoint} is not the state of a run.")
        made = state["config"]
        own = filled_from(own, made)
        fields = state.get("fields")
        held = [t.numel() for t in fields.values() if isinstance(t, Tensor)] if isinstance(fields, dict) else []
        require_held(checkpoint, own.get("model"), sum(held))
    # A problem that draws random numbers while it is made draws the same ones in every process.
    seed_generators(require_integer("seed", own["seed"], 0))
    trainer = build_trainer(own, problem)
    if state is not None:
        require_same_run(trainer.config, made)
        trainer.resume(checkpoint, state)
    settings = build_certificate_settings(trainer.config)
    require_possible(trainer.problem, settings, trains_value=trainer.fields.value is not None)
    return TrainingRun(config, trainer, settings, state, tuple(notes))


def train(run: TrainingRun, folder: Path) -> None:
    """Carry out ``run`` in ``folder``; if it is finished already, say so and make files that are missing. Of several
    processes the first does all of that, and the others `assist` it."""
    if not run.trainer.ranks.first:
        return assist(run.trainer)
    require_unlinked(folder)
    with only_writer(folder):
        for note in run.notes:
            log.warning("warning: %s", note)
        # Hydra wrote the configuration that was asked for, not that of the resumed run.
        if run.state is not None or len(starts(folder)) > 1:
            keep_configuration(folder, run.config)
        if run.state is not None:
            result = result_of(folder, run.state, run.trainer.config)
            lacking = missing(folder, run.trainer, run.settings)
            if result is not None and lacking is not None:
                log.info("%s lacks %s; what is missing is made.", folder, lacking)
            if result is not None and lacking == REPORT:  # made of the other files
                write_report(folder, run.trainer.problem, run.trainer.config)
                lacking = None
            if result is not None and lacking is None:
                log.info("\n%s\n%s is finished; a larger trainer.steps would go on.", result, folder)
                return
        run_to_end(run.trainer, run.settings, folder)


def run_to_end(trainer: Trainer, settings: CertificateSettings, folder: Path) -> Certificate:
    """The certificate of `ending`. Raises `InputError` when a loss stops being finite or the user's problem fails, after
    handing out the results of the best quick evaluation so far."""
    started = time.perf_counter()
    end = ending(trainer, settings, folder)
    kind = end.controller.kind
    known = kind != "value" or trainer.problem.knows_control_matrix
    handed = f"controller from {kind}" if known else "no controller"
    log.info("%s, %.0f s in all, in %s", handed, time.perf_counter() - started, folder)
    if trainer.settings.figures:
        log.info("to look at: %s", folder / REPORT)
    if end.failed is not None:
        raise InputError(f"{end.failed.rstrip('.')}; the controller in {folder} is that of {handed_out(trainer)}.")
    return end.certificate


def assist(trainer: Trainer) -> None:
    """The work of a process that is not the first of its run: its share of every step and of the certificate. It writes
    nothing."""
    if trainer.fresh:
        seed_generators(trainer.seed)
    with Signals() as signals:
        trainer.fit(Observer(), signals=signals)
        while not trainer.ranks.from_first(bool):
            postpone(trainer.state)
            trainer.fit(Observer(), signals=signals)


def handed_out(trainer: Trainer) -> str:
    """A sentence on which controller a run that could not go on hands out."""
    return "the best evaluation before" if trainer.health.best else f"step {trainer.step}, without any evaluation"


def ending(
    trainer: Trainer,
    settings: CertificateSettings,
    folder: Path,
    watch: Callable[[Path, Trainer], Monitor] = Monitor,
    exits: bool = True,
) -> Ending:
    """Train to the end and fill ``folder``: events, `checkpoints/`, `certificate.json`, `controller.safetensors`, figures,
    `metrics.json` for problems with metrics, and `report.html`; returns the results. ``watch`` makes the run's monitor; with
    ``exits`` a second signal ends the process.

    A resumed trainer goes on where it is. SIGTERM and Ctrl-C raise `Preempted` once the state is saved. Raises `InputError`
    when there is nothing to hand out, and `StorageError` when a file cannot be written.
    """
    last = folder / "checkpoints" / LAST
    for place in (folder, last.parent, *folder.glob(".hydra/resume_*")):
        sweep_temporaries(place)
    if trainer.fresh:
        seed_generators(trainer.seed)
    log.info(summary(trainer))
    try:
        with Signals(exits) as signals, watch(folder, trainer) as monitor:
            if trainer.settings.figures:
                monitor.pictures = glimpse
            trainer.tell, failure = lambda stage: monitor.stages(f"certifying: {stage}"), None
            try:
                certificate, fields = _trained(trainer, settings, monitor, last, signals)
            except (Exception, SystemExit) as error:
                failure = failure_of(trainer, error)
                if failure is None:
                    raise
                trainer.ranks.leave()
                certificate, fields = salvaged(trainer, settings, failure, monitor)
            controller = hand_out(trainer, certificate, fields, folder, monitor, failure)
    except OSError as error:
        raise StorageError(f"{folder} cannot be written to: {error.strerror or error}.") from None
    log.info("\n%s", table(certificate.to_dict(), certificate.searches))
    found = None
    if settings.trajectories:
        with unless_it_failed(failure, trainer):
            found = write_metrics(trainer.problem, controller.policy, trainer.seed, folder)
    if trainer.settings.figures:
        write_report(folder, trainer.problem, trainer.config)
    complete(folder)
    return Ending(certificate, controller, found, failure)


def _trained(
    trainer: Trainer, settings: CertificateSettings, monitor: Monitor, last: Path, signals: Signals
) -> tuple[Certificate, Fields]:
    """Train to the end; the certificate and its fields. A target gap counts as reached only by the full certificate."""
    target = trainer.settings.target_gap
    while True:
        signals.saved = False
        reason = trainer.fit(monitor, last, signals)
        signals.saved = True  # from here on a signal need not wait
        signals.take()
        monitor.stopped(trainer, f"Training stopped: {trainer.why_stopped}", settings)
        ended = partial(_certified, trainer, settings, target if reason == TARGET_GAP else None)
        certificate, fields, enough = trainer.ranks.from_first(ended, lambda end: end[-1])
        if enough:
            return certificate, fields
        log.info("step %d: the certified gap is not %g yet; training goes on.", trainer.step, target)
        postpone(trainer.state)


def _certified(
    trainer: Trainer, settings: CertificateSettings, target: float | None
) -> tuple[Certificate, Fields, bool]:
    """The certificate, its fields, and whether its gap is below ``target``, or there is no target."""
    fields, note = trainer.evaluator.choose(trainer.run)
    fields = trainer.evaluator.tightened(fields, trainer.run, settings, trainer.tell)
    certificate = trainer.certify(settings, fields)
    gap = certificate.gap["certified"]
    enough = target is None or (gap is not None and gap <= target)
    return with_warnings(trainer, certificate, [note] if note else []) if enough else certificate, fields, enough


def summary(trainer: Trainer) -> str:
    """A summary of what is about to be trained, in a few lines."""
    problem, settings, constants = trainer.problem, trainer.settings, trainer.constants
    weights = sum(p.numel() for p in trainer.fields.parameters())
    name, method = trainer.names
    used = ", ".join(f"{k} = {getattr(constants, k):.4g} ({constants.sources[k]})" for k in ("M", "C_V", "C_u"))
    lines = [
        f"{name}: d = {problem.dim}, m = {problem.control_dim}, rho = {problem.discount:g}, q = {problem.exponent:g}",
        *([problem.measures.text] if problem.measures else []),
        f"{method}: {', '.join(trainer.objective.fields)}, {weights:,} weights, {settings.dtype} on {settings.torch_device}",
        f"{settings.steps:,} steps of {settings.batch} states, seed {trainer.seed}",
        *([f"going on from step {trainer.step:,}"] if trainer.step else []),
        *([trainer.state.warm.plan] if trainer.state.warm is not None and not trainer.state.warm.done else []),
        f"bounds: {used}",
        *(f"warning: {warning}" for warning in (*constants.warnings, *trainer.objective.notes)),
    ]
    width = shutil.get_terminal_size().columns
    return "\n".join(["", *(line if len(line) <= 2 * width else line[: 2 * width] for line in lines)])
