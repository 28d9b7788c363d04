"""The end of a run: write its results, also where it could not go on, and check that all of them are there."""

import contextlib
import copy
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from ocp_torch.certificate import Certificate, CertificateSettings
from ocp_torch.control.controller import Controller
from ocp_torch.control.policies import BOUNDING
from ocp_torch.control.saved import FILE_NAME
from ocp_torch.errors import InputError, StorageError
from ocp_torch.fields import SUBSOLUTION, Fields
from ocp_torch.files.storage import write_atomically
from ocp_torch.maths.seeds import generators_kept
from ocp_torch.problems.blame import blamed
from ocp_torch.runs import canvas
from ocp_torch.runs.figures import FieldFigures, interval_figure
from ocp_torch.runs.metrics.measures import has_metrics
from ocp_torch.runs.metrics.trial import METRICS
from ocp_torch.runs.pictures.picture import motion
from ocp_torch.runs.pictures.scenes import scene
from ocp_torch.runs.report.report import REPORT
from ocp_torch.steppers import NonFiniteError
from ocp_torch.steppers.nonfinite import BROKEN_PROBLEM
from ocp_torch.training.health import sanity_warnings
from ocp_torch.training.monitor import Monitor
from ocp_torch.training.stopping import FAILED, NOT_FINITE
from ocp_torch.training.trainer import Trainer

# This file exists while the results are being written: a run that was killed meanwhile is known by it.
MARK = "checkpoints/unfinished"


def failure_of(trainer: Trainer, error: BaseException) -> str | None:
    """A sentence why the run cannot go on, where a loss or the user's problem failed; `None` for any other ``error``."""
    if isinstance(error, NonFiniteError):
        trainer.stopped = NOT_FINITE
        failure = f"Training stopped at step {trainer.step}, before the update: {error}"
        if trainer.health.best is None and BROKEN_PROBLEM not in failure:
            raise InputError(failure) from None  # without an evaluation nobody knows since when it has diverged
        return failure
    told = blamed(error, type(trainer.problem))
    if told is None:
        return None
    trainer.stopped = FAILED
    return f"Training stopped at step {trainer.step}: {told}"


@contextlib.contextmanager
def unless_it_failed(failure: str | None, trainer: Trainer):
    """Skip the rest of the body where the user's problem fails in it and has failed before (``failure``); where it fails for
    the first time, raise `ProblemError`."""
    try:
        yield
    except (Exception, SystemExit) as error:
        told = blamed(error, type(trainer.problem))
        if told is None or isinstance(error, StorageError):
            raise
        if failure is None:
            raise told from None


def salvaged(
    trainer: Trainer, settings: CertificateSettings, failure: str, monitor: Monitor
) -> tuple[Certificate, Fields]:
    """The results of a run that cannot go on: fields and certificate of its best quick evaluation, refined; or, where the
    problem fails again, as they were, and nothing counts; without any evaluation those of the present fields. `InputError` if
    there are none."""
    best, seen = trainer.health.best, trainer.health.certificate
    if best is None and trainer.step == 0:
        raise InputError(failure)
    fields = trainer.averaged_fields if best is None else trainer.evaluator.best_fields()
    step = trainer.step if best is None else best.step
    notes = [f"handed out are the averaged fields of step {step}. {failure}"]
    monitor.stopped(trainer, failure, settings)
    with unless_it_failed(failure, trainer):
        return with_warnings(trainer, trainer.certify(settings, fields), notes), fields
    if seen is None:
        raise InputError(failure)
    notes.append(
        f"the numbers are those of the quick evaluation at step {step}, which claims nothing: the problem failed again when "
        "they were refined."
    )
    # It looked neither for walls that paths jump over nor for peaks in steep places, on which every gap rests.
    unclaimed = replace(seen.assumptions, problem_holds=False)
    certificate = replace(seen, run=replace(trainer.run, step=step), assumptions=unclaimed)
    return replace(certificate, warnings=[*seen.warnings, *trainer.health.notes, *notes]), fields


def with_warnings(trainer: Trainer, certificate: Certificate, notes: list[str]) -> Certificate:
    """``certificate`` with the ``notes`` and the warnings of the run."""
    found = sanity_warnings(trainer.problem, trainer.constants, certificate, trainer.seed)
    fresh = [note for note in (*notes, *trainer.health.notes, *found) if note not in certificate.warnings]
    return replace(certificate, warnings=[*certificate.warnings, *fresh])


def hand_out(
    trainer: Trainer, certificate: Certificate, fields: Fields, folder: Path, monitor: Monitor, failure: str | None
) -> Controller:
    """Write the controller of ``certificate``, the certificate and figures; returns the controller."""
    write_atomically(folder / MARK, lambda path: path.write_text("a resume makes what is missing\n"))
    named = certificate.controller or certificate.subject
    kind = named or ("value" if fields.value is not None else "density")
    controller = controller_of(trainer, certificate, kind, with_subsolution(fields, certificate, kind))
    controller.save(folder / FILE_NAME)
    write_atomically(folder / "certificate.json", certificate.save)
    drawn: dict = {}
    if trainer.settings.figures:
        monitor.stages("figures")
        figures = {"certificate": interval_figure(certificate.to_dict())}
        with unless_it_failed(failure, trainer):
            how = trainer.constants, trainer.objective.occupation
            followed = certificate.followed or kind, certificate.occupation
            figures |= FieldFigures(trainer.problem, controller.fields, *how, *followed).figures()
            moved = motion(trainer.problem, controller.policy, trainer.seed)
            figures |= {} if moved is None else {"motion": moved}
        drawn = canvas.drawn(figures)
        canvas.save(drawn, folder / "figures")
    monitor.finish(certificate, drawn, _flat(trainer.config), trainer.step)
    return controller


def glimpse(trainer: Trainer) -> dict[str, np.ndarray]:
    """Pictures of `V`, `u` and `mu` in the middle of training, which leave the random generators as they were."""
    how = trainer.constants, trainer.objective.occupation
    with generators_kept():
        return canvas.drawn(FieldFigures(trainer.problem, trainer.averaged_fields, *how, quick=True).figures())


def with_subsolution(fields: Fields, certificate: Certificate, kind: str) -> Fields:
    """``fields`` with the subsolution of ``certificate``'s lower bound; else with their own subsolution if the controller of
    ``kind`` or the one followed uses it; else without any."""
    used = BOUNDING in (kind, certificate.followed)
    found = certificate.subsolution or (fields.subsolution if used else None)
    others = {name: network for name, network in fields.networks.items() if name != SUBSOLUTION}
    if found is None:
        return Fields(others)
    return Fields({**others, SUBSOLUTION: copy.deepcopy(found).to(next(fields.parameters()))})


def controller_of(trainer: Trainer, certificate: Certificate, kind: str, fields: Fields) -> Controller:
    """The controller of policy ``kind`` that ``trainer`` hands out, with the averaged ``fields``."""
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


def _flat(config: dict, prefix: str = "") -> dict:
    """A nested configuration as one level with dotted names; values that TensorBoard does not take become JSON."""
    flat: dict = {}
    for key, value in config.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value if isinstance(value, bool | int | float | str) else json.dumps(value)
    return flat


def complete(folder: Path) -> None:
    """Note that all results are written."""
    (folder / MARK).unlink(missing_ok=True)


def missing(folder: Path, trainer: Trainer, settings: CertificateSettings) -> str | None:
    """The results that the run in ``folder`` lacks, in words, or `None`."""
    files = ["certificate.json", FILE_NAME]
    if trainer.settings.figures:
        files += ["figures/certificate.png", *(["figures/motion.png"] if scene(trainer.problem) is not None else [])]
        files.append(REPORT)
    if settings.trajectories and has_metrics(trainer.problem):
        files.append(METRICS)
    absent = [file for file in files if not (folder / file).is_file()]
    if absent in ([], [REPORT]) and (folder / MARK).exists():
        return "some of its last files"
    return ", ".join(absent) or None
