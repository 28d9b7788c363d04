"""From a configuration to a run under way: a fresh one, or one that goes on."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from ocp_torch.certificate import CertificateSettings
from ocp_torch.certificate.checks.possible import require_possible
from ocp_torch.errors import InputError, require_integer
from ocp_torch.files.limits import require_held
from ocp_torch.files.reading import require_unlinked
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.runs.closing import missing
from ocp_torch.runs.resume import (
    filled_from,
    keep_configuration,
    latest_subfolder,
    load_state,
    require_same_run,
    result_of,
)
from ocp_torch.runs.run import run_session
from ocp_torch.training.generators import seed_generators
from ocp_torch.training.trainer import Trainer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Prepared:
    """A trainer ready to run; for one that was resumed also the state it was given and what was said of damaged files."""

    trainer: Trainer
    certificate_settings: CertificateSettings
    state: dict | None = None
    notes: tuple[str, ...] = ()


def prepare(config: dict) -> Prepared:
    """Build what ``config`` describes, and put it where the checkpoint is that its ``resume`` names.

    Raises `InputError` for any wrong field, damaged file, or change that a resume cannot make.
    """
    config = dict(config)
    path = config.pop("resume", None)
    if path is None:
        trainer = _built(config)
        return Prepared(trainer, _certificate_settings(trainer))
    state, checkpoint, notes = load_state(Path(path))
    made = state.get("config") if isinstance(state, dict) else None
    if not isinstance(made, dict):
        raise InputError(f"{checkpoint} is not the state of a run.")
    filled = filled_from(config, made)
    require_held(checkpoint, filled.get("model"), numbers_in(state))
    trainer = _built(filled)
    require_same_run(trainer.config, made)
    trainer.resume(checkpoint)
    return Prepared(trainer, _certificate_settings(trainer), state, tuple(notes))


def numbers_in(state: dict) -> int:
    """How many weights the fields of a run's ``state`` have."""
    fields = state.get("fields")
    return sum(t.numel() for t in fields.values() if isinstance(t, Tensor)) if isinstance(fields, dict) else 0


def _built(config: dict) -> Trainer:
    """The trainer of ``config``: a problem that draws random numbers is met with the same ones in every process."""
    seed_generators(require_integer("seed", config["seed"], 0))
    return build_trainer(config)


def _certificate_settings(trainer: Trainer) -> CertificateSettings:
    settings = build_certificate_settings(trainer.config)
    require_possible(trainer.problem, settings, trains_value=trainer.fields.value is not None)
    return settings


def train(config: dict, folder: Path) -> None:
    """One run in ``folder``, from wherever it is to its end."""
    require_unlinked(folder)
    run = prepare(config)
    for note in run.notes:
        log.warning("warning: %s", note)
    # What Hydra wrote is what was asked for, not what the run is.
    if run.state is not None or latest_subfolder(folder) != folder / ".hydra":
        keep_configuration(folder, config)
    if run.state is not None:
        result = result_of(folder, run.state, run.trainer.config)
        lacking = missing(folder, run.trainer, run.certificate_settings)
        if result is not None and lacking is not None:
            log.info("%s lacks %s; what is missing is made.", folder, lacking)
        elif result is not None:
            log.info("\n%s\n%s is finished; a larger trainer.steps would go on.", result, folder)
            return
    run_session(run.trainer, run.certificate_settings, folder)
