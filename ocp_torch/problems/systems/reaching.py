"""The base class of arms, vehicles and quadrotors: a target to come near to, and round obstacles to keep off."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from ocp_torch.errors import InputError, require_number, require_numbers, shown
from ocp_torch.problems.physical.system import System


class Reaching(System, ABC):
    """A system with a target and obstacles in physical space, in metres; a subclass makes `f` of them."""

    def pursue(
        self,
        space: int,
        target: Sequence[float],
        obstacles: Sequence[Sequence[float]],
        clearance: float,
        target_weight: float,
        obstacle_weight: float,
    ) -> None:
        """Set a ``target`` of ``space`` coordinates, 2 or 3, ``obstacles`` of as many and a radius, felt ``clearance`` from
        their surface, and the weights of both in the cost. Raises `InputError` for wrong ones."""
        self.target = require_numbers("problem.target", target, space)
        if isinstance(obstacles, str) or not isinstance(obstacles, Sequence):
            form = f"[{', '.join('xyz'[:space])}, radius]"
            raise InputError(f"problem.obstacles is {shown(obstacles)}, but must be a list of {form}.")
        self.obstacles = [require_numbers(f"problem.obstacles[{i}]", o, space + 1) for i, o in enumerate(obstacles)]
        for i, obstacle in enumerate(self.obstacles):
            require_number(f"problem.obstacles[{i}][{space}]", obstacle[space], above=0.0)
        self.clearance = require_number("problem.clearance", clearance, above=0.0)
        self.target_weight = require_number("problem.target_weight", target_weight, above=0.0)
        self.obstacle_weight = require_number("problem.obstacle_weight", obstacle_weight, at_least=0.0)
        self._target = torch.tensor(self.target, dtype=torch.float64)
        self._balls = torch.tensor(self.obstacles, dtype=torch.float64).reshape(-1, space + 1)

    def bound_cost(self, farthest: float) -> None:
        """Set the bound of the cost, as the square distance from the target is at most ``farthest`` square metres."""
        most = self.target_weight * farthest + self.obstacle_weight * len(self.obstacles)
        self.state_cost_bound = max(most, self.failure_cost or 0.0)

    @abstractmethod
    def to_target(self, x: Tensor) -> Tensor:
        """The shortest way to the target, in metres, ``(N, space)``."""

    @abstractmethod
    def gaps(self, x: Tensor, balls: Tensor) -> Tensor:
        """Metres from parts of the body to the surface of each of the ``balls``, ``(N, ...)``; negative inside."""

    def distance(self, x: Tensor) -> Tensor:
        """The distance from the target, in metres, ``(N,)``."""
        return self.to_target(x).norm(dim=-1)

    def gap(self, x: Tensor) -> Tensor:
        """Metres to the surface of the nearest obstacle, ``(N,)``; negative inside, infinite without obstacles."""
        if not self.obstacles:
            return torch.full_like(x[:, 0], math.inf)
        return self.gaps(x, self._like(x, "balls", self._balls)).flatten(1).amin(dim=1)


def bump(square: Tensor, reach: Tensor | float) -> Tensor:
    """`max(1 - r^2 / reach^2, 0)^3` of a ``square`` distance `r^2`: 1 at the centre, 0 from ``reach`` on."""
    return (1.0 - square / reach**2).clamp_min(0.0) ** 3
