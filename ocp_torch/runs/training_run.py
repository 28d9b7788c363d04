"""From a configuration to a run that is ready to go: nothing is written, and all that is wrong is told."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from ocp_torch.certificate import CertificateSettings
from ocp_torch.certificate.settings import require_possible
from ocp_torch.errors import InputError, require_integer
from ocp_torch.files.limits import require_held
from ocp_torch.runs.build import build_certificate_settings, build_trainer
from ocp_torch.runs.configuration import load_state
from ocp_torch.runs.resume import filled_from, require_same_run
from ocp_torch.training.state import seed_generators
from ocp_torch.training.trainer import Trainer


@dataclass(frozen=True)
class TrainingRun:
    """A run that is ready to go: its trainer, where it begins or where its checkpoint left it; and of one that was resumed
    the ``state`` it was given, and a sentence on each newer checkpoint that is damaged."""

    config: dict
    trainer: Trainer
    certificate_settings: CertificateSettings
    state: dict | None = None
    notes: tuple[str, ...] = ()


def training_run(config: dict) -> TrainingRun:
    """The run that the plain ``config`` describes, at the checkpoint that its ``resume`` names, which is read once.

    Raises `InputError` for any wrong field, damaged file, or change that a resume cannot make; writes nothing.
    """
    own = {name: value for name, value in config.items() if name != "resume"}
    if config.get("resume") is None:
        trainer = _seeded_trainer(own)
        return TrainingRun(config, trainer, _certificate_settings(trainer))
    state, checkpoint, notes = load_state(Path(config["resume"]))
    made = state.get("config") if isinstance(state, dict) else None
    if not isinstance(made, dict):
        raise InputError(f"{checkpoint} is not the state of a run.")
    filled = filled_from(own, made)
    require_held(checkpoint, filled.get("model"), _count_weights(state))
    trainer = _seeded_trainer(filled)
    require_same_run(trainer.config, made)
    trainer.resume(checkpoint, state)
    return TrainingRun(config, trainer, _certificate_settings(trainer), state, tuple(notes))


def _count_weights(state: dict) -> int:
    """How many weights the fields of a run's ``state`` have."""
    fields = state.get("fields")
    return sum(t.numel() for t in fields.values() if isinstance(t, Tensor)) if isinstance(fields, dict) else 0


def _seeded_trainer(config: dict) -> Trainer:
    """The trainer of ``config``: a problem that draws random numbers is met with the same ones in every process."""
    seed_generators(require_integer("seed", config["seed"], 0))
    return build_trainer(config)


def _certificate_settings(trainer: Trainer) -> CertificateSettings:
    settings = build_certificate_settings(trainer.config)
    require_possible(trainer.problem, settings, trains_value=trainer.fields.value is not None)
    return settings
