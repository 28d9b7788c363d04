r"""A `V` fitted to values that a simulation or a grid gives: a contraction, so that it does not stall where a hinge has no
gradient; and it asks a problem for evaluations alone, for no derivative of the dynamics."""

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ocp_torch.control.pace import Pace
from ocp_torch.fields import Fields
from ocp_torch.fields.logarithmic import Logarithmic
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems import Problem
from ocp_torch.problems.starts import drawn_starts
from ocp_torch.steppers.fitting import optimizer_maker
from ocp_torch.training.warm_start.grid import GridValues
from ocp_torch.training.warm_start.pieces import STARTS_PER_PIECE, Trajectories
from ocp_torch.training.warm_start.settings import WarmStartSettings
from ocp_torch.training.warm_start.targets import Targets
from ocp_torch.training.warm_start.trial import TRIAL_STARTS, Trial

FIT_STEPS = 32  # of least squares in a round: an acrobot's round takes six times as long to simulate as 16 of them
BATCH = 2048  # states of a step
LEARNING_RATE = 2e-3  # of SOAP, multiplied by the `fastest` of a source
AVERAGE_STEP = 0.5  # part of the way to the network that the average moves after each round
# Length in turns over which errors of a gradient count: Pendulum-v1 lost 1.1 to 1.4 % of the return with it, 5 % and more
# without gradients.
GRADIENT_LENGTH = 0.08
# By these steps the `V` that is trained for the bound learns the one found here, at states of the whole torus: on a limited
# pendulum to 1.4 % of the spread of `V`.
TEACHING_STEPS = 400
TEACHING_RATE = 1e-2  # the first learning rate


class ValueIteration:
    """Fits a copy of ``network``, a fresh `V` of ``problem``; `best` are the weights whose controller cost least so far.

    ``done`` says that it is over. All that changes is in `state_dict`: a resumed one goes on to the same bits.
    """

    def __init__(self, problem: Problem, network: Logarithmic, settings: WarmStartSettings, seed: int) -> None:
        self.problem, self.settings = problem, settings
        self.network = copy.deepcopy(network).requires_grad_(True)
        self.average = copy.deepcopy(network).requires_grad_(False)
        self.optimizer = optimizer_maker("soap", LEARNING_RATE)(list(self.network.parameters()))
        self.like, pace = next(network.parameters()).detach(), Pace.of(problem)
        place = lambda number: derive_seed(seed, Branch.WARM_START, number)
        self.generator = torch.Generator().manual_seed(derive_seed(seed, Branch.WARM_START))
        self.source: GridValues | Trajectories = GridValues(problem, pace, self.like)
        if not GridValues.suits(problem):
            starts = drawn_starts(problem, STARTS_PER_PIECE * settings.pieces, place(0)).to(self.like)
            self.source = Trajectories(problem, pace, starts, settings, self.generator, float(network.unit))
        self.trial = Trial(problem, pace, drawn_starts(problem, TRIAL_STARTS, place(1)).to(self.like), place(2))
        self.round, self.done = 0, False
        # The loss of the last fit, and the costs of the last trial and of the best one.
        self.loss, self.cost, self.least = math.nan, math.nan, math.inf
        self.found, self.best = False, self._weights()  # whether a controller is better than none, and its weights

    def advance(self) -> bool:
        """Make a round. Returns whether a trial was made after it."""
        if self.round == 0:
            self.least = self.trial.cost_of_nothing()
        falling = 0.5 * (1.0 + math.cos(math.pi * self.round / self.settings.rounds))
        for group in self.optimizer.param_groups:
            group["lr"] = LEARNING_RATE * self.source.fastest * falling
        self._fit(self.source.targets(self.average))
        self.round += 1
        due = self.round % self.source.trial_every == 0 or self.round >= self.settings.rounds or self.done
        if due:
            self._try()
        return due

    def _fit(self, to: Targets) -> None:
        """Least squares of the relative error: near the goal, where trajectories spend their time, small ones decide."""
        weight = (to.values.clamp_min(0.0) / self.network.unit + 1.0) ** -2.0
        for _ in range(FIT_STEPS):
            rows = torch.randint(len(to.x), (min(BATCH, len(to.x)),), generator=self.generator).to(self.like.device)
            loss = (weight[rows] * self._squares(to, rows)).mean() / self.network.unit.square()
            self.loss = float(loss.detach())
            if not math.isfinite(self.loss):
                self.done = True  # what was best so far stands
                return
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
        with torch.no_grad():
            for mean, own in zip(self.average.parameters(), self.network.parameters(), strict=True):
                mean.lerp_(own, AVERAGE_STEP)

    def _squares(self, to: Targets, rows: Tensor) -> Tensor:
        """Squared errors ``(N,)`` at ``rows`` of ``to``, with those of gradients, which decide on the control, if known."""
        if to.gradients is None:
            return (self.network(to.x[rows]) - to.y[rows]).square()
        found = self.network.jet(to.x[rows])
        along = GRADIENT_LENGTH * (found.gradient - to.gradients[rows])
        return (found.value - to.y[rows]).square() + along.square().sum(dim=-1)

    def _try(self) -> None:
        """Try the present controller and keep the best; end where none better than no control is found half way."""
        self.cost = self.trial.cost_of(self.average)
        if self.cost < self.least:
            self.least, self.best, self.found = self.cost, self._weights(), True
        self.done |= self.round >= (1.0 if self.found else 0.5) * self.settings.rounds

    @property
    def drawn(self) -> int:
        """How many states the last round evaluated the problem at."""
        return self.source.drawn

    @property
    def plan(self) -> str:
        """What is about to be done, as a sentence for the user."""
        return f"warm start: at most {self.settings.rounds} rounds of {self.source.plan}, now at round {self.round}"

    @property
    def outcome(self) -> str:
        """How the warm start ended, as a sentence for the user."""
        if not self.found:
            return f"the warm start found no controller better than none in {self.round} rounds; training starts afresh"
        if not math.isfinite(self.loss):
            return f"the warm start ended in round {self.round}, as its fit is not finite; the best V before is taken"
        return f"warm start: a controller of cost {self.least:.4g} after {self.round} rounds, a candidate from now on"

    def hand_over(self, all_fields: Sequence[Fields]) -> None:
        """Put the best `V` so far, if there is one, in its place in each of ``all_fields``; at the end of the warm start the
        `V` that is trained for its bound learns it too."""
        if not self.found:
            return
        for fields in all_fields:
            fields.trajectory_value.load_state_dict(self.best)
        if self.done:
            first = all_fields[0]
            taught = self._taught(copy.deepcopy(first.value), first.trajectory_value)
            for fields in all_fields:
                fields.value.load_state_dict(taught)

    def _taught(self, pupil: nn.Module, teacher: nn.Module) -> dict[str, Tensor]:
        """The weights of ``pupil``, a network in the problem's units, once it gives what ``teacher`` does."""
        pupil.requires_grad_(True)
        optimizer = optimizer_maker("soap", TEACHING_RATE)(list(pupil.parameters()))
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, TEACHING_STEPS)
        scale = getattr(pupil, "scale", 1.0)
        for _ in range(TEACHING_STEPS):
            x = torch.rand(BATCH, self.problem.dim, generator=self.generator).to(self.like)
            with torch.no_grad():
                wanted = teacher(x)
            optimizer.zero_grad()
            ((pupil(x) - wanted) / scale).square().mean().backward()
            optimizer.step()
            schedule.step()
        return pupil.state_dict()

    def _weights(self) -> dict[str, Tensor]:
        return {name: tensor.detach().clone() for name, tensor in self.average.state_dict().items()}

    def state_dict(self) -> dict:
        plain = {name: getattr(self, name) for name in SAVED}
        if self.done:  # what is left of it is in the fields
            return plain
        modules = {name: getattr(self, name).state_dict() for name in ("network", "average", "optimizer")}
        return {
            **modules,
            **plain,
            **self.source.state_dict(),
            "best": self.best,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict) -> None:
        """Restore what `state_dict` gave. Raises `InputError` where its states are no states of the problem."""
        for name in SAVED:
            setattr(self, name, type(getattr(self, name))(state[name]))
        if self.done:
            return
        self.source.load_state_dict(state)
        self.average.load_state_dict(state["best"])  # which shows that it fits
        self.best = self._weights()
        for name in ("network", "average", "optimizer"):
            getattr(self, name).load_state_dict(copy.deepcopy(state[name]))
        self.generator.set_state(state["generator"])


# Attributes that are saved as they are.
SAVED = ("round", "done", "found", "loss", "cost", "least")
