r"""Fitted value iteration along simulated pieces of trajectory: a contraction, so that it does not stall where a hinge has no
gradient; and it asks a problem for evaluations alone, for no derivative of the dynamics."""

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ocp_torch.control.pace import Pace
from ocp_torch.errors import InputError
from ocp_torch.fields import Fields
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.problems.starts import drawn_starts
from ocp_torch.steppers.fitting import optimizer_maker
from ocp_torch.training.warm_start.pieces import lambda_returns, roll
from ocp_torch.training.warm_start.settings import WarmStartSettings
from ocp_torch.training.warm_start.trial import STARTS, Trial

# Parts of the pieces that start uniformly, and where earlier pieces ended; the rest start as `mu0` says.
UNIFORM, GOING_ON = 0.125, 0.5
# Of the least squares: steps a round, states a step, learning rate of SOAP. The average moves half way after each round.
FITS, BATCH, RATE, HALF = 16, 2048, 2e-3, 0.5
# An error counts in units of `V` itself and this part of its mean: near the goal, where trajectories spend their time, small
# ones decide. On a limited pendulum and a cart-pole controllers came sooner than with equal weights.
LEVEL = 0.2
# A trial follows so many rounds.
TRIAL_EVERY = 10
# After so many trials none of which is better by that part than the best, it goes on from the best at half the rate; the
# second time it is over. The best is doing nothing at first.
PATIENCE, BETTER = 3, 0.002
# Starts that pieces draw from, for each piece.
POOLED = 8


class ValueIteration:
    """Fits a copy of ``network``, a fresh `V` of ``problem``; `best` are the weights whose controller cost least so far.

    ``done`` says that it is over. All that changes is in `state_dict`: a resumed one goes on to the same bits.
    """

    def __init__(self, problem: Problem, network: nn.Module, settings: WarmStartSettings, seed: int) -> None:
        self.problem, self.settings = problem, settings
        self.network = copy.deepcopy(network).requires_grad_(True)
        self.average = copy.deepcopy(network).requires_grad_(False)
        self.optimizer = optimizer_maker("soap", RATE)(list(self.network.parameters()))
        self.like, self.pace = next(network.parameters()).detach(), Pace.of(problem)
        place = lambda number: derive_seed(seed, Branch.WARM_START, number)
        self.generator = torch.Generator().manual_seed(derive_seed(seed, Branch.WARM_START))
        self.starts = drawn_starts(problem, POOLED * settings.pieces, place(0)).to(self.like)
        self.trial = Trial(problem, self.pace, drawn_starts(problem, STARTS, place(1)).to(self.like), place(2))
        self.ends: Tensor | None = None  # (k, d), where pieces ended
        self.round, self.stale, self.restarts, self.done = 0, 0, 0, False
        # Of the last fit, of the last trial and of the best one.
        self.loss, self.cost, self.least = math.nan, math.nan, math.inf
        self.found, self.best = False, self._weights()  # whether a controller is better than none, and its weights
        self.largest = math.inf if problem.state_cost_bound is None else float(problem.state_cost_bound)
        self.scale = float(getattr(network, "scale", 1.0))

    def advance(self) -> bool:
        """One round; whether a trial was made after it."""
        if self.round == 0:
            self.least = self.trial.cost_of_nothing()
        x = self._draw()
        pieces = roll(self.problem, self.average, x, self.pace, self.settings.steps, self.generator)
        # No controller that is worth having costs more than the dearest state.
        values = pieces.values.clamp(0.0, self.largest)
        y = lambda_returns(pieces.costs, values, self.problem.discount, self.pace.step, self.settings.trace)
        self.ends = pieces.states[-1][self._pick(len(x), round(GOING_ON * len(x)))]
        self._fit(pieces.states[:-1].flatten(0, 1), y.flatten(), values[:-1].flatten())
        self.round += 1
        due = self.round % TRIAL_EVERY == 0 or self.round >= self.settings.rounds or self.done
        if due:
            self._try()
        return due

    def _draw(self) -> Tensor:
        """Where the pieces of a round start, ``(N, d)``."""
        count = self.settings.pieces
        ends = [] if self.ends is None else [self.ends]
        uniform = torch.rand(round(UNIFORM * count), self.problem.dim, generator=self.generator).to(self.like)
        rest = count - len(uniform) - sum(map(len, ends))
        return torch.cat([uniform, self.starts[self._pick(len(self.starts), rest)], *ends])

    def _pick(self, of: int, count: int) -> Tensor:
        return torch.randint(of, (count,), generator=self.generator).to(self.like.device)

    def _fit(self, x: Tensor, y: Tensor, values: Tensor) -> None:
        """Least squares to ``y`` ``(N,)`` at ``x`` ``(N, d)``, weighed by ``values``, in which chance has no part."""
        weight = (values / values.mean().clamp_min(1e-30) + LEVEL) ** -2.0
        weight = weight / weight.mean()
        for _ in range(FITS):
            rows = self._pick(len(x), min(BATCH, len(x)))
            loss = (weight[rows] * ((self.network(x[rows]) - y[rows]) / self.scale).square()).mean()
            self.loss = float(loss.detach())
            if not math.isfinite(self.loss):
                self.done = True  # what was best so far stands
                return
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        with torch.no_grad():
            for mean, own in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(own, HALF)

    def _try(self) -> None:
        """What the present controller costs; keep the best, go back to it when it is long ago, and end."""
        self.cost = self.trial.cost_of(self.average)
        if self.cost < (1.0 - BETTER) * self.least:
            self.least, self.best, self.stale, self.found = self.cost, self._weights(), 0, True
        else:
            self.stale += 1
        if self.stale >= PATIENCE:
            self.done |= self.restarts > 0
            self.stale, self.restarts = 0, self.restarts + 1
            for module in (self.network, self.average) if self.found else ():
                module.load_state_dict(self.best)
            for group in self.optimizer.param_groups:
                group["lr"] *= 0.5
        self.done |= self.round >= self.settings.rounds

    @property
    def drawn(self) -> int:
        """How many states a round draws."""
        return self.settings.pieces * self.settings.steps

    @property
    def plan(self) -> str:
        """What is about to be done, as a user is told."""
        pace = f"{self.settings.pieces} pieces of {self.settings.steps} steps of {self.pace.step:.3g}"
        return f"warm start: at most {self.settings.rounds} rounds of {pace}, now at round {self.round}"

    @property
    def outcome(self) -> str:
        """How it ended, as a user is told."""
        if not self.found:
            return f"the warm start found no controller better than none in {self.round} rounds; training starts afresh"
        if not math.isfinite(self.loss):
            return f"the warm start ended in round {self.round}, as its fit is not finite; the best V before is taken"
        return f"warm start: a controller of cost {self.least:.4g} after {self.round} rounds, a candidate from now on"

    @torch.no_grad()
    def hand_over(self, all_fields: Sequence[Fields]) -> None:
        """Put the best `V` so far, if there is one, in the place of both `V` of each of ``all_fields``."""
        if self.found:
            for fields in all_fields:
                for network in (fields.value, fields.trajectory_value):
                    network.load_state_dict(self.best)

    def _weights(self) -> dict[str, Tensor]:
        return {name: tensor.detach().clone() for name, tensor in self.average.state_dict().items()}

    def state_dict(self) -> dict:
        plain = {name: getattr(self, name) for name in PLAIN}
        if self.done:  # what is left of it is in the fields
            return plain
        modules = {name: getattr(self, name).state_dict() for name in ("network", "average", "optimizer")}
        ends = None if self.ends is None else self.ends.clone()
        return {**modules, **plain, "ends": ends, "best": self.best, "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict) -> None:
        """The way back from `state_dict`. Raises `InputError` where its states are none."""
        for name in PLAIN:
            setattr(self, name, type(getattr(self, name))(state[name]))
        if self.done:
            return
        ends, dim = state["ends"], self.problem.dim
        if ends is not None and (ends.ndim != 2 or ends.shape[1] != dim or not ends.isfinite().all()):
            raise InputError(f"the checkpoint holds ends of trajectories that are no states of {dim} coordinates.")
        self.average.load_state_dict(state["best"])  # which shows that it fits
        self.best = self._weights()
        for name in ("network", "average", "optimizer"):
            getattr(self, name).load_state_dict(copy.deepcopy(state[name]))
        self.ends = None if ends is None else ends.to(self.like)
        self.generator.set_state(state["generator"])


# What is saved just as it is.
PLAIN = ("round", "stale", "restarts", "done", "found", "loss", "cost", "least")
