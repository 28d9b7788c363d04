"""What every method has in common: which fields it trains, who moves them, and one loss per player."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ocp_torch.fields.fields import Fields
from ocp_torch.maths.jets import Field
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.generator import Generator
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

# How a method turns its fields into mu: Lemma 2, Lemma 3, or a network for log mu.
CLOSED, SADDLE, NETWORK = "closed", "saddle", "network"

# Where no `M` is known to be large enough, the weight of the penalty grows geometrically to `M` during each round.
LEAST_WEIGHT = 1.0 / 20.0  # part of `M` at the start of a round; a heavier one leaves `V` stuck far below `V*`
GROWTH_PART = 0.7  # part of a round in which it grows; a longer growth leaves `V` less time to become feasible
# Factor of the squared slack's weight there, from the second round on: the simulated gap of dubins was 1.42 % without it,
# and 1.06 % with it.
LATER_RESIDUAL = 32.0


@dataclass(frozen=True)
class Phase:
    """The state of training at a step, passed on to losses: an objective has neither a clock nor a state.

    ``constants`` are `M`, `C_V` and `C_u` in force; ``progress`` is the part of the present round that is done, in [0, 1];
    the samples are one of ``shares`` equal parts of a batch; ``growing`` is the `growth`, where that is a tensor; ``later``
    says that a round is over already.
    """

    constants: Constants
    progress: float = 1.0
    shares: int = 1
    growing: Any = None
    later: bool = False

    @property
    def growth(self) -> Any:
        """The part of `M` that is in force: all of it, but where no `M` is known (see `Dual`)."""
        if self.growing is not None:
            return self.growing
        return LEAST_WEIGHT ** max(0.0, 1.0 - self.progress / GROWTH_PART) if self.constants.unbounded else 1.0

    @property
    def residual_growth(self) -> float:
        """The factor of the squared slack's weight: 1, but from the second round on where no `M` is known (see `Dual`)."""
        return LATER_RESIDUAL if self.later and self.constants.unbounded else 1.0

    @property
    def form(self) -> tuple:
        """All by which the computation of losses may change, but for `growth` and `Objective.needs_divergences`, the only
        things that losses may take from `progress`."""
        constants = self.constants
        return constants.M, constants.C_V, constants.C_u, constants.unbounded, self.shares, self.residual_growth


class Objective(ABC):
    """A one-player objective is minimised; a two-player one is a game in which each player minimises its own loss.

    ``players`` maps a player to the fields it moves; ``delays`` maps a player to the part of each round it waits for before
    its first move, where that is not 0; ``occupation`` says how the fields give `mu` (see `trained_policies`), `None` where
    they do not; ``notes`` is what a user should be told of the form that was chosen. An objective is not changed by a run:
    what changes is in the `Phase`.
    """

    players: Mapping[str, tuple[str, ...]]
    delays: Mapping[str, float] = {}
    occupation: str | None = None

    def __init__(self, problem: Problem, notes: tuple[str, ...] = ()) -> None:
        self.rho, self.cost, self.notes = problem.discount, problem.control_cost, notes

    @property
    def fields(self) -> tuple[str, ...]:
        """All fields the method trains."""
        return tuple(name for names in self.players.values() for name in names)

    def generator(self, samples: Samples) -> Generator:
        """`L^u` at ``samples``."""
        return Generator(samples, self.rho, self.cost)

    def admissible(self, fields: Fields) -> Field:
        """`w` within what a limit on the control and the network for `mu` allow."""
        return self.cost.admissible(fields.control_density, lambda x: fields.log_occupation(x).exp())

    def needs_divergences(self, phase: Phase) -> bool:
        """Whether `losses` reads `div a` and `div B` at ``phase``."""
        return False

    @abstractmethod
    def losses(self, fields: Fields, samples: Samples, phase: Phase) -> dict[str, Tensor]:
        """One scalar loss per player, each a mean over ``samples``; a player without one does not move at ``phase``."""

    @torch.no_grad()
    def diagnostics(self, fields: Fields, samples: Samples) -> dict[str, Tensor]:
        """By how much the two constraints are violated on ``samples``: the HJB slack and the Liouville residual."""
        shown: dict[str, Tensor] = {}
        generator = self.generator(samples)
        if fields.value is not None:
            slack = generator.hjb_slack(generator.jet(fields.value)).clamp_min(0.0)
            shown |= {"slack_mean_positive": samples.mean(slack), "slack_maximum": slack.max()}
        given = samples.div_a is not None and samples.div_B is not None
        if given and fields.control_density is not None and fields.log_occupation is not None:
            _, inflow = generator.control_inflow(self.admissible(fields))
            _, outflow = generator.occupation_outflow(fields.log_occupation)
            shown["residual_mean_absolute"] = samples.mean((inflow - outflow).abs())
        return shown
