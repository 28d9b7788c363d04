"""Everything of a run that changes while it goes on: to be saved as plain data and tensors, and put back."""

import copy
import random
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ocp_torch.errors import InputError, notes, require_integer, require_number, visible
from ocp_torch.fields import Fields
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives import Phase
from ocp_torch.problems.constants import Constants
from ocp_torch.steppers import Average, NonFiniteError, Stepper, advance
from ocp_torch.training.batches import Batches
from ocp_torch.training.health import Health
from ocp_torch.training.settings import TrainerSettings
from ocp_torch.training.warm_start.iteration import ValueIteration

# What learning rates depend on: where it differs at a resume, the rates are those of the new configuration.
rates_of = lambda config: (config["optimizer"], config["schedule"], config["trainer"]["steps"])
# Attributes that are saved as they are.
SAVED = ("config", "step", "round", "samples", "seconds", "elapsed", "pending", "retry", "ended", "refined", "solved")


@dataclass
class TrainState:
    """All that a run needs to go on exactly, and the names of its problem and method."""

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
    samples: int = 0  # states drawn for steps so far
    seconds: float = 0.0  # spent in steps alone
    elapsed: float = 0.0  # with evaluations and checkpoints
    pending: bool = False  # a full certificate may reach the target gap, and is to be made
    retry: int = 0  # none is made before this step
    ended: bool = False  # nothing was left to do when it was saved
    refined: bool = False  # the Gauss-Newton steps that are due at this step are done
    solved: bool = False  # they found the solution before the end of the round
    warm: ValueIteration | None = None  # the warm start, where there is one

    def state_dict(self) -> dict:
        """All of it as plain data and tensors."""
        constants = self.constants
        return {
            **dict(zip(("problem", "method"), self.names, strict=True)),
            **{name: getattr(self, name) for name in SAVED},
            "bounds": {"M": constants.M, "warnings": list(constants.warnings), "unbounded": constants.unbounded},
            "fields": self.fields.state_dict(),
            "average": self.average.state_dict(),
            "stepper": self.stepper.state_dict(),
            "batches": self.batches.state_dict(),
            "watch": self.health.state_dict(),  # the name that files have known it by
            "warm": None if self.warm is None else self.warm.state_dict(),
            "generators": generator_states(),
        }

    def load_state_dict(self, saved: dict, settings: TrainerSettings) -> None:
        """Restore what `state_dict` gave: with the same configuration the run goes on to the same bits.

        With another `optimizer`, `schedule` or `trainer.steps` the run is taken as one of these ``settings``: its round, warm
        start and learning rates are those such a run would have at this step. Raises `InputError` for a state of another
        problem or method, or weights that do not fit; another odd state raises whatever its odd part leads to.
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
        self.refined = bool(saved.get("refined", True))  # runs from before there were such steps have none
        self.solved = bool(saved.get("solved", False))
        constants = saved["bounds"]
        warnings, unbounded = notes(constants["warnings"]), bool(constants["unbounded"])
        self.constants = replace(self.constants, M=constants["M"], warnings=warnings, unbounded=unbounded)
        for module, weights in ((self.fields, saved["fields"]), (self.average, saved["average"])):
            _require_weights(module, weights)
            module.load_state_dict(weights)
        if saved["watch"]["fields"] is not None:
            _require_weights(self.fields, saved["watch"]["fields"])
        moves = None
        if rates_of(saved["config"]) != rates_of(self.config):
            self.round = settings.round_at(self.step)
            moves = {player: settings.moves(self.step, self.round, d) for player, d in self.stepper.delays.items()}
        self.stepper.load_state_dict(saved["stepper"], moves=moves)
        self.batches.load_state_dict(saved["batches"])
        self.health.load_state_dict(saved["watch"])
        if self.warm is not None:
            self.warm.load_state_dict(saved["warm"])
        # Last, since restoring the rest may draw from them.
        restore_generators(saved["generators"])

    def try_step(self, phase: Phase) -> None:
        """Make a step of all players, which shows whether their optimisers can work with what they were given; it stays."""
        with suppress(NonFiniteError):  # the run itself will say so
            advance(self.stepper, self.average, self.batches.draw, phase)

    def require_finite(self) -> None:
        """Raise `NonFiniteError` where a weight is not finite: such a state is neither evaluated nor saved."""
        name = next((n for n, parameter in self.fields.named_parameters() if not parameter.isfinite().all()), None)
        if name is not None:
            raise NonFiniteError(f"the weights of {name} are not finite; try a smaller optimizer.lr, or stepper.clip.")


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


# The process's own random generators: a problem of a user's may draw from them, so a run seeds and keeps them too.


def seed_generators(seed: int) -> None:
    """Start every global generator from ``seed`` alone."""
    branch = derive_seed(seed, Branch.GLOBAL_GENERATORS)
    torch.manual_seed(branch)
    np.random.seed(branch % 2**32)  # noqa: NPY002 (the global one is what a user's code draws from)
    random.seed(branch)


def generator_states() -> dict:
    """The states of all global generators, as tensors and plain numbers that a checkpoint can hold."""
    state: Any = np.random.get_state()  # noqa: NPY002
    name, keys, *rest = state
    version, words, spare = random.getstate()
    states = {
        "torch": torch.get_rng_state(),
        "numpy": [name, keys.tolist(), *map(float, rest)],
        "python": [version, list(words), spare],
    }
    if torch.cuda.is_initialized():
        states["cuda"] = torch.cuda.get_rng_state_all()
    return states


def restore_generators(states: dict) -> None:
    """Put every global generator where `generator_states` found it."""
    torch.set_rng_state(states["torch"])
    name, keys, position, has_gauss, cached = states["numpy"]
    state = (str(name), np.array(keys, dtype=np.uint32), int(position), int(has_gauss), float(cached))
    np.random.set_state(state)  # noqa: NPY002
    version, words, spare = states["python"]
    random.setstate((int(version), tuple(map(int, words)), spare))
    if "cuda" in states and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(states["cuda"])
