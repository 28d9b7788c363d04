"""Certify a saved controller again, on the same or on fresh evaluation states."""

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ocp_torch.certificate import Certificate, CertificateSettings, Run, Trained, certify_fields, table
from ocp_torch.certificate.settings import require_possible
from ocp_torch.control.controller import Controller
from ocp_torch.control.saved import load_controller
from ocp_torch.errors import InputError, require_integer, require_section
from ocp_torch.files.limits import require_modest_run
from ocp_torch.files.reading import kind
from ocp_torch.runs.build import build_certificate_settings, build_network, build_problem, use_threads
from ocp_torch.runs.metrics.trial import write_metrics
from ocp_torch.runs.pictures.picture import animate, require_gif
from ocp_torch.training.health import sanity_warnings
from ocp_torch.training.settings import MOST_THREADS

log = logging.getLogger(__name__)


def recertification(config: dict) -> Callable[[], Certificate]:
    """A function that certifies the saved controller of ``config`` again, on states of ``seed`` (`None`: its run's), and
    writes a GIF of its motion to ``animation``. Checks ``config`` first: `InputError` for a wrong field."""
    controller, seed, animation = load_run(config), config["seed"], config["animation"]
    if seed is not None:
        require_integer("seed", seed, 0)
    if animation is not None:
        animation = require_gif(controller.problem, animation)
    settings = settings_for(controller, config)
    require_possible(controller.problem, settings, trains_value=controller.fields.value is not None)

    def recertify() -> Certificate:
        certificate = certify_saved(controller, settings, seed)
        if animation is not None:
            animate(controller.problem, controller.policy, animation, seed or 0)
            log.info("animated in %s", animation)
        return certificate

    return recertify


def load_run(config: dict) -> Controller:
    """The controller of ``config["run"]``, which is a run's folder, a folder of runs, or a file. A user's own problem comes
    from ``config["problem"]``, that is from the command line, never from the file."""
    path = Path(str(config["run"]))
    if kind(path) is None:
        raise InputError(
            f"run is {str(path)!r}, which does not exist; give a run's folder, one of runs, or a controller.safetensors."
        )
    problem = build_problem(config["problem"]) if config["problem"] else None
    return load_controller(path, problem=problem)


def settings_for(controller: Controller, config: dict) -> CertificateSettings:
    """The settings of the controller's own run, with those that ``config`` sets instead. Raises `InputError` where the run's
    own would take more than a file may ask for."""
    own, asked = controller.config.get("certificate") or {}, require_section("certificate", config["certificate"])
    changed = {k: v for k, v in asked.items() if v is not None and k != "stage"}
    section = require_section("certificate.stage", {} if asked.get("stage") is None else asked["stage"])
    stage = {k: v for k, v in section.items() if v is not None}
    named = {f"certificate.{k}" for k in changed} | {f"certificate.stage.{k}" for k in stage}
    require_modest_run(config["run"], controller.config, named)
    stage = {**(own.get("stage") or {}), **stage}
    return build_certificate_settings({"certificate": {**own, **changed, "stage": stage}})


def certify_saved(controller: Controller, settings: CertificateSettings, seed: int | None = None) -> Certificate:
    """Print and return the certificate of ``controller``; with its run's ``seed`` the numbers are those of the run."""
    threads = controller.config.get("trainer", {}).get("threads", 1)
    use_threads(require_integer("trainer.threads", threads, 1, maximum=MOST_THREADS))
    run = Run.read(controller.certificate)
    if seed is not None:
        run = replace(run, seed=require_integer("seed", seed, 0))
    trained = Trained(controller.fields, controller.occupation, build_network(controller.model), controller.kind)
    certificate = certify_fields(controller.problem, trained, controller.constants, settings, run)
    found = sanity_warnings(controller.problem, controller.constants, certificate, run.seed)
    fresh = [note for note in found if note not in certificate.warnings]
    certificate = replace(certificate, warnings=[*certificate.warnings, *fresh])
    log.info("\n%s", table(certificate.to_dict(), certificate.searches))
    if settings.trajectories:
        write_metrics(controller.problem, controller.policy, run.seed, None)
    return certificate
