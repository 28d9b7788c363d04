"""Training batches: states of a sampler and, where that pays, states that the controller in training visits."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor

from ocp_torch.compute.cuda_graphs import Eager
from ocp_torch.compute.processes import SingleProcess
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.errors import InputError, require_number
from ocp_torch.fields import VALUE, Fields
from ocp_torch.maths.sampling import ImportanceSampler
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.objectives import Objective, Phase
from ocp_torch.problems import Problem
from ocp_torch.problems.samples import Samples
from ocp_torch.training.importance import scores

# The part of a batch that is visited states where no `M` is known and none is configured: more of them make the penalty more
# exact, and leave fewer states for the integrals.
VISITED_PART = 0.25
LARGEST_VISITED_PART = 0.9  # at least a tenth of a batch is for the integrals
# From batch to batch visited states move by Euler-Maruyama steps: longer ones leave the flow's paths, shorter ones repeat
# nearly the same states.
STEP_TIME = 0.05  # of a step at most, in units of 1 / rho
LONGEST_STEP = 0.05  # on the torus


@dataclass(eq=False)
class Batches:
    r"""``size`` states a batch for ``objective``; the part ``visited`` of them comes from the closed loop of the present `V`.

    Visited states follow the controller of `V`, and start again at a uniform state at the rate `rho`: in the long run their
    law is about the occupation measure of that controller. They carry no weight in integrals but, in proportion to the time
    they spend where they are, `Samples.penalty_weight`. That makes the penalty of D(M) exact also where `mu*` is unbounded:
    it is exact wherever the measure that weighs the slack dominates `mu*` (proof of Proposition 3), which no multiple of the
    uniform one then does. And in many dimensions a goal is so small that uniform states never meet it.

    ``visited`` null takes a quarter where `Constants.unbounded`, and none elsewhere. Raises `InputError` where it is not in
    [0, 0.9], or above 0 for a method without `V` or a problem that has data only where it was recorded.
    """

    problem: Problem
    fields: Fields
    objective: Objective
    sampler: Any  # one of `SAMPLERS`, or of the rows of a data set
    size: int
    seed: int
    visited: float | None = None
    ranks: SingleProcess = field(default_factory=SingleProcess, init=False)  # the processes that share each batch

    def __post_init__(self) -> None:
        if self.visited is not None:
            self.visited = require_number("sampler.visited", self.visited, at_least=0.0, at_most=LARGEST_VISITED_PART)
        self._possible = VALUE in self.objective.fields and self.problem.has_simulator
        if self.visited and not self._possible:
            elsewhere = "a data set has no data at other states"
            lacks = "this method has no V to follow" if self.problem.has_simulator else elsewhere
            raise InputError(f"sampler.visited is {self.visited:g}, but {lacks}; leave it out.")
        self.generator = torch.Generator().manual_seed(derive_seed(self.seed, Branch.VISITS))
        self.states: Tensor | None = None  # (k, d), where the visited states are now
        self._noises = 0  # columns of sigma, once known
        self.replay = Eager()  # how the problem is evaluated

    def draw(self, phase: Phase) -> Samples:
        """This process's share of the next batch, with what the objective needs at ``phase``, in the precision and on the
        device of the fields. All processes draw the same states, and each evaluates the problem at its share. Raises
        `InputError` where a batch cannot be shared equally."""
        like = next(self.fields.parameters())
        part = self.visited
        if part is None:
            part = VISITED_PART if self._possible and phase.constants.unbounded else 0.0
        count = min(int(part * self.size), self.size - 1)
        divergences = self.objective.needs_divergences(phase)
        self.ranks.require_shares("trainer.batch", self.size)
        self.ranks.require_shares("the number of visited states in trainer.batch", count)
        if not self.problem.has_simulator:
            rows = self.sampler.draw(self.size)[self.ranks.share]
            return self.problem.samples(rows, divergences=divergences).to(like)
        x, weight = self._drawn(self.size - count, phase, like, divergences)
        inputs = [x, weight, *(self._moves(count, like) if count else ())]
        found: list[Any] = self.replay(("samples", divergences), partial(self._evaluated, divergences), inputs)
        *columns, states = found
        self.states = states if count else self.states
        return Samples(*columns)

    def _drawn(self, count: int, phase: Phase, like: Tensor, divergences: bool) -> tuple[Tensor, Tensor | None]:
        """``count`` states of the sampler, and their weights where it has any; one that is due learns from a pool before."""
        sampler = self.sampler
        if not isinstance(sampler, ImportanceSampler):
            return sampler.draw(count, like.device)[self.ranks.share], None
        if sampler.due:
            x, weight = sampler.pool()
            pool = self.problem.samples(x.to(like.device), divergences=divergences)
            whole = replace(phase, shares=1)
            sampler.learn(x, weight, scores(self.objective, self.fields, pool, whole, sampler.generator))
        x, weight = (part[self.ranks.share] for part in sampler.draw_weighted(count))
        return x.to(like.device), weight.to(like)

    def _moves(self, count: int, like: Tensor) -> list[Tensor | None]:
        """The ``count`` visited states, and the random numbers by which `_moved` moves them."""
        if self.states is None or len(self.states) != count:
            self.states = self._uniform(count, like)
        states, driven = self.states.to(like), None
        if self.problem.noisy:
            self._noises = self._noises or cast(Tensor, self.problem.noise(states[:1])).shape[-1]
            driven = torch.randn(count, self._noises, generator=self.generator).to(like)
        return [states, driven, torch.rand(count, generator=self.generator).to(like), self._uniform(count, like)]

    def _evaluated(self, divergences: bool, x: Tensor, weight: Tensor | None, *moves: Tensor) -> list[Tensor | None]:
        """The columns of a batch at the states ``x`` and at the visited ones, and these after their move."""
        drawn = self.problem.samples(x, divergences=divergences)
        if weight is not None:
            drawn = replace(drawn, weight=weight)
        if not moves:
            return [*drawn.columns, None]
        states, *numbers = moves
        visited = self.problem.samples(states, divergences=divergences)
        # Every process moves all of them, so that they are the same everywhere.
        moved, spent = self._moved(visited, *numbers)
        # The drawn states stand for all integrals, as they would without the visited ones; the penalties see both.
        part = self.size / (self.size - len(states))
        drawn = replace(drawn, weight=part * drawn.weight, penalty_weight=drawn.weight)
        visited = replace(visited, weight=torch.zeros_like(visited.weight), penalty_weight=spent)
        return [*Samples.concatenate([drawn, visited.take(self.ranks.share)]).columns, moved]

    @torch.no_grad()
    def _moved(self, at: Samples, driven: Tensor | None, chance: Tensor, fresh: Tensor) -> tuple[Tensor, Tensor]:
        """The visited states ``at`` a short time later along the closed loop, or started again at ``fresh`` ones, ``(k, d)``;
        and that time as a part of the longest, ``(k,)``."""
        policy, rho = ValuePolicy(self.problem, self.fields.value), self.problem.discount
        u = policy(at.x)
        velocity = at.velocity(u)
        time = (LONGEST_STEP / velocity.norm(dim=-1).clamp_min(1e-12)).clamp_max(STEP_TIME / rho)
        moved = at.x + time.unsqueeze(-1) * velocity
        if at.noise is not None:
            moved = moved + time.sqrt().unsqueeze(-1) * torch.einsum("ndk,nk->nd", at.noise, driven)
        moved = moved.remainder(1.0)
        again = (chance < 1.0 - torch.exp(-rho * time)) | ~torch.isfinite(moved).all(dim=-1)
        return torch.where(again.unsqueeze(-1), fresh, moved), time * rho / STEP_TIME

    def _uniform(self, count: int, like: Tensor) -> Tensor:
        return torch.rand(count, self.problem.dim, generator=self.generator).to(like)

    def state_dict(self) -> dict:
        return {
            "sampler": self.sampler.state_dict(),
            "generator": self.generator.get_state(),
            "states": None if self.states is None else self.states.clone(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore what `state_dict` gave. Raises `InputError` where the visited states are no states of the problem."""
        self.sampler.load_state_dict(state["sampler"])
        self.generator.set_state(state["generator"])
        states, dim = state["states"], self.problem.dim
        if states is not None and (states.ndim != 2 or states.shape[1] != dim or not states.isfinite().all()):
            raise InputError(f"the checkpoint holds visited states that are no states of {dim} coordinates.")
        self.states = states
