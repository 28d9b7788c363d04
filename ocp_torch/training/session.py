"""One run from start to finish: train, certify, draw, save."""

from __future__ import annotations

import json
import logging
import shutil
import time
from pathlib import Path

from ocp_torch.certificate import Certificate, CertificateSettings, table
from ocp_torch.controller import Controller
from ocp_torch.errors import InputError
from ocp_torch.steppers import NonFiniteError
from ocp_torch.training import figures
from ocp_torch.training.monitor import Monitor
from ocp_torch.training.trainer import Trainer

log = logging.getLogger(__name__)


def run_session(trainer: Trainer, certificate_settings: CertificateSettings, folder: Path) -> Certificate:
    """Fill ``folder`` with a run: events, `checkpoints/last.pt`, `certificate.json`, `controller.safetensors`, figures.

    Raises `InputError` when a loss stops being finite.
    """
    started = time.perf_counter()
    settings = trainer.settings
    log.info(summary(trainer))
    with Monitor(folder, settings.steps, settings.progress) as monitor:
        try:
            trainer.fit(monitor, folder / "checkpoints" / "last.pt")
        except NonFiniteError as error:
            raise InputError(f"Training stopped at step {trainer.step}, before the update: {error}") from None
        certificate = trainer.certify(certificate_settings)
        monitor.record(certificate, trainer.step)
        monitor.hyper_parameters(flatten(trainer.config), certificate)
        certificate.save(folder / "certificate.json")
        if certificate.best_perf is not None:
            kind = certificate.best_perf[0]
        else:
            kind = "value" if trainer.averaged_fields.value is not None else "density"
        controller_of(trainer, certificate, kind).save(folder / "controller.safetensors")
        if settings.figures:
            drawn = figures.draw(trainer.problem, trainer.averaged_fields, trainer.bounds, trainer.objective.occupation)
            drawn["certificate"] = figures.interval(certificate.to_dict())
            figures.save(drawn, folder / "figures")
            monitor.figures(drawn, trainer.step)
    log.info("\n%s", table(certificate.to_dict(), certificate.searches))
    log.info("controller from %s, %.0f s in all, in %s", kind, time.perf_counter() - started, folder)
    return certificate


def controller_of(trainer: Trainer, certificate: Certificate, kind: str) -> Controller:
    """The controller of law ``kind`` that ``trainer`` hands out, from its averaged fields."""
    return Controller(
        problem=trainer.problem,
        fields=trainer.averaged_fields,
        bounds=trainer.bounds,
        occupation=trainer.objective.occupation,
        kind=kind,
        model=trainer.config["model"],
        certificate=certificate.to_dict(),
        config=trainer.config,
    )


def summary(trainer: Trainer) -> str:
    """What is about to be trained, in a few lines."""
    problem, settings, bounds = trainer.problem, trainer.settings, trainer.bounds
    weights = sum(p.numel() for p in trainer.fields.parameters())
    name, method = trainer.names
    used = ", ".join(f"{k} = {getattr(bounds, k):.4g} ({bounds.sources[k]})" for k in ("M", "C_V", "C_u"))
    lines = [
        f"{name}: d = {problem.dim}, m = {problem.control_dim}, rho = {problem.discount:g}, q = {problem.exponent:g}",
        f"{method}: {', '.join(trainer.objective.fields)}, {weights:,} weights, {settings.dtype} on {settings.torch_device}",
        f"{settings.steps:,} steps of {settings.batch} states, seed {trainer.seed}",
        f"bounds: {used}",
        *(f"warning: {warning}" for warning in (*bounds.warnings, *trainer.objective.notes)),
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
