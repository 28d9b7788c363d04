"""Everything of a run that changes while it goes on: to be saved as plain data and tensors, and put back."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import torch

from ocp_torch.errors import InputError, notes, require_integer, require_number, visible
from ocp_torch.fields import Fields
from ocp_torch.problems.constants import Constants
from ocp_torch.steppers import Average, NonFiniteError, Stepper
from ocp_torch.training.batches import Batches
from ocp_torch.training.generators import generator_states, restore_generators
from ocp_torch.training.health import Health
from ocp_torch.training.rounds import Rounds

# What decides the learning rates: where one of these differs at a resume, they are those of the new configuration.
RATES = (("optimizer",), ("schedule",), ("trainer", "steps"))


@dataclass
class TrainState:
    """What a run needs to go on exactly, and what it is a run of."""

    names: tuple[str, str]  # of the problem and of the method
    config: dict  # what all parts were built from
    fields: Fields
    average: Average
    stepper: Stepper
    batches: Batches
    health: Health
    constants: Constants  # in force
    step: int = 0
    round: int = 0
    samples: int = 0  # states drawn so far
    seconds: float = 0.0  # spent in steps alone
    elapsed: float = 0.0  # with evaluations and checkpoints
    pending: bool = False  # a full certificate may reach the target gap, and is to be made
    retry: int = 0  # none is made before this step
    ended: bool = False  # nothing was left to do when it was saved

    def state_dict(self) -> dict:
        """All of it as plain data and tensors."""
        (problem, method), constants = self.names, self.constants
        return {
            "problem": problem,
            "method": method,
            "config": self.config,
            "step": self.step,
            "round": self.round,
            "bounds": {"M": constants.M, "warnings": list(constants.warnings), "unbounded": constants.unbounded},
            "samples": self.samples,
            "seconds": self.seconds,
            "elapsed": self.elapsed,
            "ended": self.ended,
            "pending": self.pending,
            "retry": self.retry,
            "fields": self.fields.state_dict(),
            "average": self.average.state_dict(),
            "stepper": self.stepper.state_dict(),
            "batches": self.batches.state_dict(),
            "watch": self.health.state_dict(),
            "generators": generator_states(),
        }

    def load_state_dict(self, saved: dict, rounds: Rounds) -> None:
        """The way back from `state_dict`: with the same configuration the run goes on to the same bits.

        With another `optimizer`, `schedule` or `trainer.steps` the run is taken as one of these ``rounds``: its round, warm
        start and learning rates are those such a run would have at this step. Raises `InputError` for a state of another
        problem or method, or weights that are none; a state that does not fit raises whatever its odd part leads to.
        """
        for what, own in zip(("problem", "method"), self.names, strict=True):
            if saved[what] != own:
                raise InputError(f"the checkpoint belongs to the {what} {str(saved[what])[:80]!r}, not to {own!r}.")
        # Tensors of a loaded optimiser state would otherwise be those of ``saved``, and change under its owner.
        saved = copy.deepcopy(saved)
        self.step = require_integer("step of the checkpoint", saved["step"], 0)
        self.round = require_integer("round of the checkpoint", saved["round"], 0, maximum=15)
        self.samples = require_integer("samples of the checkpoint", saved["samples"], 0, maximum=2**63)
        self.seconds = require_number("seconds of the checkpoint", saved["seconds"], at_least=0.0)
        self.elapsed = require_number("elapsed of the checkpoint", saved["elapsed"], at_least=0.0)
        self.pending, self.retry = bool(saved["pending"]), int(saved["retry"])
        constants = saved["bounds"]
        warnings, unbounded = notes(constants["warnings"]), bool(constants["unbounded"])
        self.constants = replace(self.constants, M=constants["M"], warnings=warnings, unbounded=unbounded)
        best = saved["watch"]["fields"]
        for module, weights in ((self.fields, saved["fields"]), (self.average, saved["average"])):
            _require_weights(module, weights)
            module.load_state_dict(weights)
        if best is not None:
            _require_weights(self.fields, best)
        moves = None
        if any(_at(saved["config"], path) != _at(self.config, path) for path in RATES):
            self.round, objective = rounds.at(self.step), self.stepper.objective
            delays = {player: objective.delays.get(player, 0.0) for player in objective.players}
            moves = {player: rounds.moves(self.step, self.round, delay) for player, delay in delays.items()}
        self.stepper.load_state_dict(saved["stepper"], moves=moves)
        self.batches.load_state_dict(saved["batches"])
        self.health.load_state_dict(saved["watch"])
        # Last: to restore the rest may draw from them.
        restore_generators(saved["generators"])

    def require_finite(self) -> None:
        """Raise `NonFiniteError` where a weight is not finite: such a state is neither evaluated nor saved."""
        for name, parameter in self.fields.named_parameters():
            if not torch.isfinite(parameter).all():
                raise NonFiniteError(
                    f"the weights of {name} are not finite; try a smaller optimizer.lr, or stepper.clip."
                )


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
