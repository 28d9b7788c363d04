"""One step of the game: what simultaneous and extragradient steps share. The arithmetic is `torch.optim`'s."""

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from ocp_torch.compute.cuda_graphs import Eager
from ocp_torch.compute.processes import SingleProcess
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields
from ocp_torch.objectives import Objective, Phase
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
        self.parameters: dict[str, list[Any]] = {p: fields.parameters_of(n) for p, n in objective.players.items()}
        self.optimizers = {player: optimizers[player](own) for player, own in self.parameters.items()}
        self.delays = {player: objective.delays.get(player, 0.0) for player in objective.players}
        self.schedules = {player: schedule(o, self.delays[player]) for player, o in self.optimizers.items()}
        self._start = copy.deepcopy(self.state_dict())
        self._moving: dict[tuple, list[str]] = {}  # who has a loss, by the form of the phase
        self.ranks = SingleProcess()  # the processes that share batches
        self.replay = Eager()

    @property
    def replay(self) -> Eager:
        """How losses and moves are called (see `ocp_torch.compute.cuda_graphs`)."""
        return self._replay

    @replay.setter
    def replay(self, replay: Eager) -> None:
        self._replay = replay
        for optimizer in self.optimizers.values():
            if hasattr(optimizer, "replay"):
                optimizer.replay = replay.fresh()  # its own, to be forgotten apart

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
        """Go on from ``state`` exactly; or, with ``moves`` of each player, with its moments but with this stepper's own
        hyper-parameters and schedules as they are after so many moves."""
        start = copy.deepcopy(self._start)
        for player, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][player])
            schedule = self.schedules[player]
            if moves is None:
                schedule.load_state_dict(state["schedules"][player])
                continue
            schedule.load_state_dict(start["schedules"][player])
            configured = start["optimizers"][player]["param_groups"]
            for group, own in zip(optimizer.param_groups, configured, strict=True):
                group.update(own, params=group["params"])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that the optimiser did not step in between
                for _ in range(moves[player]):
                    schedule.step()

    def _parameters(self) -> list[Tensor]:
        """A copy of all parameters as they stand."""
        return torch._foreach_mul([p.detach() for p in self.fields.parameters()], 1.0)  # type: ignore[return-value]

    def _differentiate(self, samples: Samples, phase: Phase) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Set each parameter's gradient to that of its own player's loss, averaged over all `ranks`. Returns losses and
        gradient norms per player."""
        form = (*phase.form, self.objective.needs_divergences(phase))

        def differentiated(growth: Any, *columns: Tensor) -> list[Tensor]:
            found = self.objective.losses(self.fields, Samples(*columns), replace(phase, growing=growth))
            self._moving[form] = list(found)
            return [*(loss.detach() for loss in found.values()), *self._gradients(found)]

        inputs = [self.replay.number(phase.growth, samples.weight), *samples.columns]
        found: list[Any] = self.replay(("losses", form), differentiated, inputs)
        means = iter(self.ranks.mean(found))
        losses, norms = {player: next(means) for player in self._moving[form]}, {}
        for player in losses:
            for parameter in self.parameters[player]:
                parameter.grad = next(means)
            norms[player] = torch.nn.utils.get_total_norm([p.grad for p in self.parameters[player]])
        if not torch.stack([*losses.values(), *norms.values()]).isfinite().all():
            here = not all(part.isfinite().all() for part in found)
            first = lambda: first_nonfinite(self.objective, self.fields, samples, phase)
            told = self.ranks.gathered(first() if here else None)
            what = next(filter(None, told), None) or first()
            advice = "" if what.endswith(BROKEN_PROBLEM) else "; try a smaller optimizer.lr, or stepper.clip"
            raise NonFiniteError(f"{what}{advice}.")
        if self.clip is not None:
            for player, norm in norms.items():
                torch.nn.utils.clip_grads_with_norm_(self.parameters[player], self.clip, norm)
        return losses, norms

    def _gradients(self, losses: dict[str, Tensor]) -> list[Tensor]:
        """The gradients of each player's own loss in each of its parameters, player after player."""
        *_, last = losses
        found: list[Tensor] = []
        for player, loss in losses.items():
            own = self.parameters[player]
            more = player != last
            gradients = torch.autograd.grad(loss / self.unit, own, retain_graph=more, allow_unused=True)
            # A bias that only shifts V gets no gradient where only grad V matters.
            found += [torch.zeros_like(p) if g is None else g for p, g in zip(own, gradients, strict=True)]
        return found

    def _update(self, players: Iterable[str], ahead: bool = False) -> None:
        """One update of ``players`` with the gradients in place, then the projection. A player's schedule counts its own
        moves, but not those that only look ``ahead``."""
        for player in players:
            self.optimizers[player].step()
            if self.radius is not None:
                project_on_ball(self.parameters[player], self.radius)
            if not ahead:
                self.schedules[player].step()


@torch.no_grad()
def project_on_ball(parameters: list[Tensor], radius: float) -> None:
    """Scale ``parameters`` back, as one vector, onto the Euclidean ball of ``radius`` around the origin."""
    if radius <= 0:
        raise InputError(f"stepper.radius is {radius}, but must be above 0.")
    norm = torch.nn.utils.get_total_norm(parameters)
    torch._foreach_mul_(parameters, torch.clamp(radius / norm.clamp_min(1e-30), max=1.0))
