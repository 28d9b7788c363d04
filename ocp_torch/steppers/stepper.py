"""One step of the game: what simultaneous and extragradient steps share. The arithmetic is `torch.optim`'s."""

from __future__ import annotations

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from ocp_torch.errors import InputError
from ocp_torch.fields.fields import Fields
from ocp_torch.objectives.objective import Objective
from ocp_torch.objectives.phase import Phase
from ocp_torch.problems.samples import Samples
from ocp_torch.steppers.nonfinite import BROKEN_PROBLEM, NonFiniteError, first_nonfinite


@dataclass(frozen=True)
class StepReport:
    """What one step saw, per player; tensors, so that nothing is synchronised unless it is read.

    ``counted`` are the parameters, in the order of those of the fields, of the iterate that counts for an average.
    """

    losses: dict[str, Tensor]
    gradient_norms: dict[str, Tensor]
    batches: Sequence[Samples]  # what the step was given; losses and norms are those of the last one
    counted: list[Tensor]

    @property
    def samples(self) -> int:
        """How many states the step was given."""
        return sum(len(batch) for batch in self.batches)


class Stepper(ABC):
    """Moves every player of ``objective`` by its own optimiser and schedule.

    ``draws`` is how many independent batches a step takes. ``optimizers`` maps a player to a maker of its optimiser,
    ``schedule`` makes the learning-rate schedule of each, given the part of a round for which the player waits;
    ``radius``, if given, is the Euclidean ball each player's parameters are projected on after every update (the paper's
    proximal operator); ``clip``, if given, is the largest gradient norm of a player; ``unit`` is what losses are divided by
    (see `cost_unit`).
    """

    draws: int = 1

    def __init__(
        self,
        fields: Fields,
        objective: Objective,
        optimizers: dict[str, Callable[[list[Tensor]], Optimizer]],
        schedule: Callable[[Optimizer, float], LRScheduler],
        radius: float | None = None,
        clip: float | None = None,
        unit: float = 1.0,
    ) -> None:
        self.fields, self.objective, self.radius, self.clip, self.unit = fields, objective, radius, clip, unit
        self.parameters: dict[str, list[Any]] = {
            player: fields.parameters_of(names) for player, names in objective.players.items()
        }
        self.optimizers = {player: optimizers[player](self.parameters[player]) for player in objective.players}
        delays = objective.delays
        self.schedules = {p: schedule(optimizer, delays.get(p, 0.0)) for p, optimizer in self.optimizers.items()}
        self._configured = {p: _hyper_parameters(optimizer) for p, optimizer in self.optimizers.items()}
        self._unmoved = {p: copy.deepcopy(s.state_dict()) for p, s in self.schedules.items()}

    @abstractmethod
    def step(self, batches: Sequence[Samples], phase: Phase) -> StepReport:
        """One update of all players that have a loss at ``phase``, from ``draws`` independent ``batches``.

        Raises `NonFiniteError` where a loss or gradient is not finite; the parameters are then as they were.
        """

    def learning_rates(self) -> dict[str, float]:
        """The current learning rate of each player."""
        return {player: optimizer.param_groups[0]["lr"] for player, optimizer in self.optimizers.items()}

    def state_dict(self) -> dict:
        return {
            "optimizers": {player: o.state_dict() for player, o in self.optimizers.items()},
            "schedules": {player: s.state_dict() for player, s in self.schedules.items()},
        }

    def load_state_dict(self, state: dict, moves: dict[str, int] | None = None) -> None:
        """Go on from ``state`` exactly; or, with ``moves``, with its moments but with this stepper's own hyper-parameters and
        schedules, those after so many moves of each player."""
        for player, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][player])
            if moves is None:
                self.schedules[player].load_state_dict(state["schedules"][player])
                continue
            self.schedules[player].load_state_dict(copy.deepcopy(self._unmoved[player]))
            for group, configured in zip(optimizer.param_groups, self._configured[player], strict=True):
                group.update(configured)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that the optimiser did not step in between
                for _ in range(moves[player]):
                    self.schedules[player].step()

    def _parameters(self) -> list[Tensor]:
        """A copy of all parameters as they stand."""
        return [p.detach().clone() for p in self.fields.parameters()]

    def _differentiate(self, samples: Samples, phase: Phase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Set each parameter's gradient to that of its own player's loss; losses and gradient norms per player."""
        losses = self.objective.losses(self.fields, samples, phase)
        moving = {player: self.parameters[player] for player in losses}
        gradients = {}
        for i, (player, parameters) in enumerate(moving.items()):
            more = i < len(moving) - 1
            loss = losses[player] if self.unit == 1.0 else losses[player] / self.unit
            gradients[player] = torch.autograd.grad(loss, parameters, retain_graph=more, allow_unused=True)
        norms = {}
        for player, parameters in moving.items():
            for parameter, gradient in zip(parameters, gradients[player], strict=True):
                # A bias that only shifts V gets no gradient where only grad V matters.
                parameter.grad = torch.zeros_like(parameter) if gradient is None else gradient
            norms[player] = torch.nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        self._require_finite(losses, norms, samples, phase)
        if self.clip is not None:
            for player, parameters in moving.items():
                torch.nn.utils.clip_grads_with_norm_(parameters, self.clip, norms[player])
        return {player: loss.detach() for player, loss in losses.items()}, norms

    def _require_finite(
        self, losses: dict[str, Tensor], norms: dict[str, Tensor], samples: Samples, phase: Phase
    ) -> None:
        checks = torch.stack([*losses.values(), *norms.values()])
        if not torch.isfinite(checks).all():
            what = first_nonfinite(self.objective, self.fields, samples, phase)
            advice = "" if what.endswith(BROKEN_PROBLEM) else "; try a smaller optimizer.lr, or stepper.clip"
            raise NonFiniteError(f"{what}{advice}.")

    def _update(self, players: Iterable[str]) -> None:
        """One update of ``players`` with the gradients in place, then the projection."""
        for player in players:
            self.optimizers[player].step()
            if self.radius is not None:
                project_on_ball(self.parameters[player], self.radius)

    def _advance_schedules(self, players: Iterable[str]) -> None:
        """A player's schedule counts its own moves."""
        for player in players:
            self.schedules[player].step()


def _hyper_parameters(optimizer: Optimizer) -> list[dict]:
    return [{k: v for k, v in group.items() if k != "params"} for group in optimizer.param_groups]


@torch.no_grad()
def project_on_ball(parameters: list[Tensor], radius: float) -> None:
    """Scale ``parameters`` back, as one vector, onto the Euclidean ball of ``radius`` around the origin."""
    if radius <= 0:
        raise InputError(f"stepper.radius is {radius}, but must be above 0.")
    norm = torch.nn.utils.get_total_norm(parameters)
    torch._foreach_mul_(parameters, torch.clamp(radius / norm.clamp_min(1e-30), max=1.0))
