"""Everything a run needs to go on exactly, as plain data and tensors; and the way back."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from ocp_torch.errors import InputError, notes, require_integer, require_number, visible
from ocp_torch.training.generators import generator_states, restore_generators

if TYPE_CHECKING:
    from ocp_torch.training.trainer import Trainer

# What decides the learning rates: where one of these differs, they are those of the new configuration.
RATES = (("optimizer",), ("schedule",), ("trainer", "steps"))


def gather(trainer: Trainer) -> dict:
    """The state of ``trainer``; random generators last."""
    return {
        "problem": trainer.names[0],
        "method": trainer.names[1],
        "config": trainer.config,
        "step": trainer.step,
        "round": trainer.round,
        "bounds": {
            "M": trainer.constants.M,
            "warnings": list(trainer.constants.warnings),
            "unbounded": trainer.constants.unbounded,
        },
        "samples": trainer.samples,
        "seconds": trainer.seconds,
        "elapsed": trainer.elapsed,
        "ended": trainer.ended,
        "pending": trainer.pending,
        "retry": trainer.retry,
        "fields": trainer.fields.state_dict(),
        "average": trainer.average.state_dict(),
        "stepper": trainer.stepper.state_dict(),
        "batches": trainer.batches.state_dict(),
        "watch": trainer.health.state_dict(),
        "generators": generator_states(),
    }


def restore(trainer: Trainer, state: dict) -> None:
    """Put ``trainer`` where `gather` found another of its kind. With the same configuration it goes on to the same bits.

    With other `trainer.steps` the run is taken as one of the new length: its round, warm start and learning rates are
    those such a run would have at this step. Raises `InputError` for a state of another problem or method; a state that
    does not fit raises whatever its odd part leads to.
    """
    for what, own in zip(("problem", "method"), trainer.names, strict=True):
        if state[what] != own:
            raise InputError(f"the checkpoint belongs to the {what} {str(state[what])[:80]!r}, not to {own!r}.")
    # Tensors of a loaded optimiser state would otherwise be those of ``state``, and change under its owner.
    state = copy.deepcopy(state)
    trainer.step = require_integer("step of the checkpoint", state["step"], 0)
    trainer.round = require_integer("round of the checkpoint", state["round"], 0, maximum=15)
    trainer.samples = require_integer("samples of the checkpoint", state["samples"], 0, maximum=2**63)
    for name in ("seconds", "elapsed"):
        setattr(trainer, name, require_number(f"{name} of the checkpoint", state[name], at_least=0.0))
    trainer.pending, trainer.retry = bool(state["pending"]), int(state["retry"])
    constants = state["bounds"]
    warnings, unbounded = notes(constants["warnings"]), bool(constants["unbounded"])
    trainer.use(replace(trainer.constants, M=constants["M"], warnings=warnings, unbounded=unbounded))
    best = state["watch"]["fields"]
    for module, weights in ((trainer.fields, state["fields"]), (trainer.average, state["average"])):
        _require_weights(module, weights)
        module.load_state_dict(weights)
    if best is not None:
        _require_weights(trainer.fields, best)
    if any(_at(state["config"], path) != _at(trainer.config, path) for path in RATES):
        _place_in_round(trainer)
        trainer.stepper.load_state_dict(state["stepper"], moves=_moves(trainer))
    else:
        trainer.stepper.load_state_dict(state["stepper"])
    trainer.batches.load_state_dict(state["batches"])
    trainer.health.load_state_dict(state["watch"])
    restore_generators(state["generators"])


def _require_weights(module: torch.nn.Module, weights: dict) -> None:
    """Raise `InputError` unless ``weights`` are finite numbers of the names, shapes and types of those of ``module``."""
    own = module.state_dict()
    if weights.keys() != own.keys():
        raise InputError("the checkpoint holds weights of other names than those of this run's networks.")
    for name, tensor in weights.items():
        if tensor.shape != own[name].shape or tensor.dtype != own[name].dtype:
            wanted, found = (f"{tuple(t.shape)} {t.dtype}".replace("torch.", "") for t in (own[name], tensor))
            raise InputError(f"the checkpoint holds weights {found} for {visible(name, 80)}, which must be {wanted}.")
        if not torch.isfinite(tensor).all():
            raise InputError(f"the checkpoint holds weights that are not finite ({visible(name, 80)}).")


def _at(config: dict, path: tuple[str, ...]):
    for key in path:
        config = config[key]
    return config


def _place_in_round(trainer: Trainer) -> None:
    """The round that a run of the present length would be in at this step."""
    trainer.round = 0
    while trainer.step >= trainer.end and trainer.round + 1 < trainer.settings.rounds:
        trainer.round += 1


def _moves(trainer: Trainer) -> dict[str, int]:
    """How often each player would have moved by this step: each rests at the start of every round."""
    counts = {}
    for player in trainer.objective.players:
        resting, count, begin = trainer.objective.resting.get(player, 0.0), 0, 0
        for k in range(trainer.round + 1):
            length = trainer.settings.steps * 2**k
            done = min(length, trainer.step - begin)
            count += max(0, done - math.ceil(resting * length))
            begin += length
        counts[player] = count
    return counts
