"""One run from start to finish: train, certify, draw, save."""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
import time
from dataclasses import replace
from pathlib import Path

from ocp_torch.certificate import Certificate, CertificateSettings, table
from ocp_torch.certificate.trained import in_float64
from ocp_torch.control.controller import Controller
from ocp_torch.control.policies import trained_policies
from ocp_torch.errors import InputError, StorageError
from ocp_torch.fields import Fields
from ocp_torch.files.storage import sweep_temporaries, write_atomically
from ocp_torch.problems.blame import blamed
from ocp_torch.runs import closing, figures
from ocp_torch.runs.metrics import practical_figures, write_metrics
from ocp_torch.steppers import NonFiniteError
from ocp_torch.steppers.nonfinite import BROKEN_PROBLEM
from ocp_torch.training.checkpoint import LAST
from ocp_torch.training.generators import seed_generators
from ocp_torch.training.health import sanity_warnings
from ocp_torch.training.monitor import Monitor
from ocp_torch.training.signals import Signals
from ocp_torch.training.trainer import FAILED, NOT_FINITE, TARGET_GAP, Trainer

log = logging.getLogger(__name__)


def run_session(trainer: Trainer, certificate_settings: CertificateSettings, folder: Path) -> Certificate:
    """Fill ``folder`` with a run: events, `checkpoints/`, `certificate.json`, `controller.safetensors`, figures, and
    `metrics.json` for problems with numbers of their own.

    A trainer that was resumed goes on where it is. SIGTERM and Ctrl-C raise `Preempted` once the state is saved. Raises
    `InputError` when a loss stops being finite or the user's problem fails (what the best look so far gives is handed out
    first), and `StorageError`
    when a file cannot be written.
    """
    started = time.perf_counter()
    last = folder / "checkpoints" / LAST
    for place in (folder, last.parent, *folder.glob(".hydra/resume_*")):
        sweep_temporaries(place)
    if trainer.step == 0:
        seed_generators(trainer.seed)
    log.info(summary(trainer))
    try:
        with Signals() as signals, Monitor(folder, trainer) as monitor:
            trainer.tell, failure = monitor.certifying, None
            try:
                certificate, fields = _train(trainer, certificate_settings, monitor, last, signals)
            except (Exception, SystemExit) as error:
                failure = _failure(trainer, error)
                if failure is None:
                    raise
                certificate, fields = _salvage(trainer, certificate_settings, failure, monitor)
            closing.begin(folder)
            kind = _hand_out(trainer, certificate, fields, folder)
            policy = trained_policies(
                trainer.objective.occupation, trainer.problem, in_float64(fields), trainer.constants
            )[kind]
            drawn = {}
            if trainer.settings.figures:
                monitor.stages("figures")
                drawn = {"certificate": figures.interval(certificate.to_dict())}
                with _unless(failure, trainer):
                    drawn |= figures.draw(trainer.problem, fields, trainer.constants, trainer.objective.occupation)
                    drawn |= practical_figures(trainer.problem, policy, trainer.seed)
                figures.save(drawn, folder / "figures")
            monitor.finish(certificate, drawn, flatten(trainer.config), trainer.step)
    except OSError as error:
        raise StorageError(f"{folder} cannot be written to: {error.strerror or error}.") from None
    log.info("\n%s", table(certificate.to_dict(), certificate.searches))
    if certificate_settings.trajectories:
        with _unless(failure, trainer):
            write_metrics(trainer.problem, policy, trainer.seed, folder)
    closing.complete(folder)
    log.info("controller from %s, %.0f s in all, in %s", kind, time.perf_counter() - started, folder)
    if failure is not None:
        which = "the best look before" if trainer.health.best else f"step {trainer.step}, without any look"
        raise InputError(f"{failure.rstrip('.')}; the controller in {folder} is that of {which}.")
    return certificate


def _train(
    trainer: Trainer, settings: CertificateSettings, monitor: Monitor, last: Path, signals: Signals
) -> tuple[Certificate, Fields]:
    """Train to the end; the certificate, and the fields it is of. A target gap is reached when the certificate says so."""
    target = trainer.settings.target_gap
    while True:
        signals.saved = False
        reason = trainer.fit(monitor, last, signals)
        signals.saved = True  # from here on a signal need not wait
        signals.take()
        monitor.stopped(trainer, f"Training stopped: {trainer.why_stopped}", settings)
        fields, note = trainer.choose()
        certificate = trainer.certify(settings, fields)
        gap = certificate.gap["certified"]
        if reason != TARGET_GAP or (gap is not None and gap <= target):
            return with_warnings(trainer, certificate, [note] if note else []), fields
        log.info("step %d: the certified gap is not %g yet; training goes on.", trainer.step, target)
        trainer.go_on()


def _failure(trainer: Trainer, error: BaseException) -> str | None:
    """Why the run cannot go on, where a loss or the user's problem failed; `None` for any other ``error``."""
    if isinstance(error, NonFiniteError):
        trainer.stopped = NOT_FINITE
        failure = f"Training stopped at step {trainer.step}, before the update: {error}"
        if trainer.health.best is None and BROKEN_PROBLEM not in failure:
            raise InputError(failure) from None  # nobody knows how long it has diverged
        return failure
    told = blamed(error, type(trainer.problem))
    if told is None:
        return None
    trainer.stopped = FAILED
    return f"Training stopped at step {trainer.step}: {told}"


@contextlib.contextmanager
def _unless(failure: str | None, trainer: Trainer):
    """What is done with a problem that failed before may fail again, and is then left out."""
    try:
        yield
    except (Exception, SystemExit) as error:
        told = blamed(error, type(trainer.problem))
        if told is None or isinstance(error, StorageError):
            raise
        if failure is None:
            raise told from None


def _salvage(
    trainer: Trainer, settings: CertificateSettings, failure: str, monitor: Monitor
) -> tuple[Certificate, Fields]:
    """What a run that cannot go on still gives: the certificate of its best look made anew, or, where the problem fails there
    as well, as it was seen then; without any look that of the fields as they are. `InputError` when nothing."""
    best, seen = trainer.health.best, trainer.health.certificate
    if best is None and trainer.step == 0:
        raise InputError(failure)
    fields = trainer.averaged_fields if best is None else trainer.best_fields()
    step = trainer.step if best is None else best.step
    notes = [f"handed out are the averaged fields of step {step}. {failure}"]
    monitor.stopped(trainer, failure, settings)
    with _unless(failure, trainer):
        return with_warnings(trainer, trainer.certify(settings, fields), notes), fields
    if seen is None:
        raise InputError(failure)
    notes.append(
        f"the numbers are those of the quick look at step {step}: the problem failed again when they were refined."
    )
    certificate = replace(seen, run=replace(trainer.run, step=step))
    return replace(certificate, warnings=[*seen.warnings, *trainer.health.notes, *notes]), fields


def with_warnings(trainer: Trainer, certificate: Certificate, notes: list[str]) -> Certificate:
    """``certificate`` with what else a user should know of the run."""
    found = sanity_warnings(trainer.problem, trainer.constants, certificate, trainer.seed)
    fresh = [note for note in (*notes, *trainer.health.notes, *found) if note not in certificate.warnings]
    return replace(certificate, warnings=[*certificate.warnings, *fresh])


def _hand_out(trainer: Trainer, certificate: Certificate, fields: Fields, folder: Path) -> str:
    """Write `controller.safetensors` and `certificate.json`; the policy that the controller follows."""
    if certificate.controller is not None:
        kind = certificate.controller
    elif certificate.subject is not None:
        kind = certificate.subject
    else:
        kind = "value" if fields.value is not None else "density"
    controller_of(trainer, certificate, kind, fields).save(folder / "controller.safetensors")
    write_atomically(folder / "certificate.json", certificate.save)
    return kind


def controller_of(trainer: Trainer, certificate: Certificate, kind: str, fields: Fields) -> Controller:
    """The controller of policy ``kind`` that ``trainer`` hands out, from its averaged ``fields``."""
    return Controller(
        problem=trainer.problem,
        fields=fields,
        constants=trainer.constants,
        occupation=trainer.objective.occupation,
        kind=kind,
        model=trainer.config["model"],
        certificate=certificate.to_dict(),
        config=trainer.config,
    )


def summary(trainer: Trainer) -> str:
    """What is about to be trained, in a few lines."""
    problem, settings, constants = trainer.problem, trainer.settings, trainer.constants
    weights = sum(p.numel() for p in trainer.fields.parameters())
    name, method = trainer.names
    used = ", ".join(f"{k} = {getattr(constants, k):.4g} ({constants.sources[k]})" for k in ("M", "C_V", "C_u"))
    lines = [
        f"{name}: d = {problem.dim}, m = {problem.control_dim}, rho = {problem.discount:g}, q = {problem.exponent:g}",
        f"{method}: {', '.join(trainer.objective.fields)}, {weights:,} weights, {settings.dtype} on {settings.torch_device}",
        f"{settings.steps:,} steps of {settings.batch} states, seed {trainer.seed}",
        *([f"going on from step {trainer.step:,}"] if trainer.step else []),
        f"bounds: {used}",
        *(f"warning: {warning}" for warning in (*constants.warnings, *trainer.objective.notes)),
    ]
    width = shutil.get_terminal_size().columns
    return "\n".join(["", *(line if len(line) <= 2 * width else line[: 2 * width] for line in lines)])


def flatten(config: dict, prefix: str = "") -> dict:
    """A nested configuration as one level with dotted names."""
    flat: dict = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, dict) else {name: json_safe(value)}
    return flat


def json_safe(value):
    return value if isinstance(value, bool | int | float | str) else json.dumps(value)
