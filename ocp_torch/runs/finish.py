"""The end of a run: what it hands out, also where it could not go on."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path

from ocp_torch.certificate import Certificate, CertificateSettings
from ocp_torch.certificate.trained import in_float64
from ocp_torch.control.controller import Controller
from ocp_torch.control.policies import Policy, trained_policies
from ocp_torch.errors import InputError, StorageError
from ocp_torch.fields import Fields
from ocp_torch.files.storage import write_atomically
from ocp_torch.problems.blame import blamed
from ocp_torch.runs import completion, figures
from ocp_torch.runs.interval import interval_figure
from ocp_torch.runs.pictures import practical_figures
from ocp_torch.steppers import NonFiniteError
from ocp_torch.steppers.nonfinite import BROKEN_PROBLEM
from ocp_torch.training.health import sanity_warnings
from ocp_torch.training.monitor import Monitor
from ocp_torch.training.stopping import FAILED, NOT_FINITE
from ocp_torch.training.trainer import Trainer


def failure_of(trainer: Trainer, error: BaseException) -> str | None:
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
def unless_it_failed(failure: str | None, trainer: Trainer):
    """What is done with a problem that failed before may fail again, and is then left out."""
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
    """What a run that cannot go on still gives: the certificate of its best look made anew, or, where the problem fails there
    as well, as it was seen then; without any look that of the fields as they are. `InputError` when nothing."""
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
        f"the numbers are those of the quick look at step {step}: the problem failed again when they were refined."
    )
    certificate = replace(seen, run=replace(trainer.run, step=step))
    return replace(certificate, warnings=[*seen.warnings, *trainer.health.notes, *notes]), fields


def with_warnings(trainer: Trainer, certificate: Certificate, notes: list[str]) -> Certificate:
    """``certificate`` with what else a user should know of the run."""
    found = sanity_warnings(trainer.problem, trainer.constants, certificate, trainer.seed)
    fresh = [note for note in (*notes, *trainer.health.notes, *found) if note not in certificate.warnings]
    return replace(certificate, warnings=[*certificate.warnings, *fresh])


def hand_out(
    trainer: Trainer,
    certificate: Certificate,
    fields: Fields,
    folder: Path,
    monitor: Monitor,
    failure: str | None,
) -> tuple[str, Policy]:
    """Write controller, certificate and figures; the kind of the policy that the controller follows, and that policy in
    float64."""
    completion.begin(folder)
    kind = policy_kind(certificate, fields)
    controller_of(trainer, certificate, kind, fields).save(folder / "controller.safetensors")
    write_atomically(folder / "certificate.json", certificate.save)
    policy = trained_policies(trainer.objective.occupation, trainer.problem, in_float64(fields), trainer.constants)[
        kind
    ]
    drawn = {}
    if trainer.settings.figures:
        monitor.stages("figures")
        drawn = {"certificate": interval_figure(certificate.to_dict())}
        with unless_it_failed(failure, trainer):
            drawn |= figures.draw(trainer.problem, fields, trainer.constants, trainer.objective.occupation)
            drawn |= practical_figures(trainer.problem, policy, trainer.seed)
        figures.save(drawn, folder / "figures")
    monitor.finish(certificate, drawn, flatten(trainer.config), trainer.step)
    return kind, policy


def policy_kind(certificate: Certificate, fields: Fields) -> str:
    """The policy that ``certificate`` speaks of: ``value`` or ``density``."""
    named = certificate.controller or certificate.subject
    return named or ("value" if fields.value is not None else "density")


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


def flatten(config: dict, prefix: str = "") -> dict:
    """A nested configuration as one level with dotted names."""
    flat: dict = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, dict) else {name: json_safe(value)}
    return flat


def json_safe(value):
    return value if isinstance(value, bool | int | float | str) else json.dumps(value)
