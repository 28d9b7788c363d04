r"""What the warm start learns in general: pieces of trajectory under the greedy controller of a `V`, and what they say of the
value of every state on them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.pace import Pace
from ocp_torch.errors import InputError
from ocp_torch.maths.jets import Field
from ocp_torch.problems import Problem
from ocp_torch.problems.equilibrium import Equilibrium, equilibrium
from ocp_torch.problems.samples import Samples
from ocp_torch.training.warm_start.settings import WarmStartSettings
from ocp_torch.training.warm_start.targets import Targets

# Parts of the pieces by where they start; the others start as `mu0` says.
UNIFORM_PART = 0.125  # uniformly
CONTINUED_PART = 0.5  # where earlier pieces ended
RESTING_PART = 0.125  # about a state of rest, if any: without these a pendubot leaned by 22 degrees for ever; not tuned
# The quadratic `V`, in its unit, at starts about a state of rest: up to a standard deviation of the cost (not tuned).
RISES = (0.1, 100.0)
LEAST_CURVATURE = 1e-6  # of the quadratic `V`, as a part of its largest, where it is as good as flat
TINY = 1e-300  # the least curvature where all are 0
LARGEST_OFFSET = 0.25  # of such a start in each coordinate, in turns
STARTS_PER_PIECE = 8  # states of `mu0`, for each piece, in the pool that pieces draw their starts from


class Trajectories:
    """Returns along pieces of trajectory of ``problem``, which start among ``starts`` ``(M, d)`` and elsewhere; ``unit`` is
    the unit of `V`."""

    trial_every = 10  # rounds
    fastest = 1.5  # first learning rate of a fit, in units of the usual one

    def __init__(
        self,
        problem: Problem,
        pace: Pace,
        starts: Tensor,
        settings: WarmStartSettings,
        generator: torch.Generator,
        unit: float,
    ) -> None:
        self.problem, self.pace, self.starts, self.settings, self.generator = problem, pace, starts, settings, generator
        self.rest, self.unit = equilibrium(problem), unit
        self.ends: Tensor | None = None  # (k, d), where pieces ended
        self.largest = math.inf if problem.state_cost_bound is None else float(problem.state_cost_bound)
        self.drawn = settings.pieces * settings.steps  # states a round

    @property
    def plan(self) -> str:
        return f"{self.settings.pieces} pieces of {self.settings.steps} steps of {self.pace.step:.3g}"

    def targets(self, average: Field) -> Targets:
        """The states along new pieces under the controller of ``average``, and their lambda-returns."""
        x = self._draw()
        pieces = roll(self.problem, average, x, self.pace, self.settings.steps, self.generator)
        # No controller that is worth having costs more than the dearest state.
        values = pieces.values.clamp(0.0, self.largest)
        y = lambda_returns(pieces.costs, values, self.problem.discount, self.pace.step, self.settings.trace)
        self.ends = pieces.states[-1][self._pick(len(x), round(CONTINUED_PART * len(x)))]
        return Targets(pieces.states[:-1].flatten(0, 1), y.flatten(), values[:-1].flatten())

    def _draw(self) -> Tensor:
        """The starts ``(N, d)`` of the pieces of a round."""
        count = self.settings.pieces
        ends = [] if self.ends is None else [self.ends]
        uniform = torch.rand(round(UNIFORM_PART * count), self.problem.dim, generator=self.generator).to(self.starts)
        about = [] if self.rest is None else [self._about(self.rest, round(RESTING_PART * count))]
        left = count - len(uniform) - sum(map(len, ends)) - sum(map(len, about))
        return torch.cat([uniform, self.starts[self._pick(len(self.starts), left)], *ends, *about])

    def _about(self, rest: Equilibrium, count: int) -> Tensor:
        """States ``(count, d)`` about that of ``rest``, in all directions and at values of the quadratic `V` in `RISES`."""
        drawn = lambda sampler, n: sampler(count, n, dtype=torch.float64, generator=self.generator)
        low, high = (math.log(self.unit * units) for units in RISES)
        height = (low + (high - low) * drawn(torch.rand, 1)).exp()
        sizes, axes = torch.linalg.eigh(0.5 * rest.bend)
        along = height.sqrt() * normalize(drawn(torch.randn, self.problem.dim), dim=-1)
        away = (along / sizes.clamp_min(max(LEAST_CURVATURE * float(sizes[-1]), TINY)).sqrt()) @ axes.T
        return (rest.at + away.clamp(-LARGEST_OFFSET, LARGEST_OFFSET)).remainder(1.0).to(self.starts)

    def _pick(self, of: int, count: int) -> Tensor:
        return torch.randint(of, (count,), generator=self.generator).to(self.starts.device)

    def state_dict(self) -> dict:
        return {"ends": None if self.ends is None else self.ends.clone()}

    def load_state_dict(self, state: dict) -> None:
        """Restore what `state_dict` gave. Raises `InputError` where its states are no states of the problem."""
        ends, dim = state["ends"], self.problem.dim
        if ends is not None and (ends.ndim != 2 or ends.shape[1] != dim or not ends.isfinite().all()):
            raise InputError(f"the checkpoint holds ends of trajectories that are no states of {dim} coordinates.")
        self.ends = None if ends is None else ends.to(self.starts)


@dataclass(frozen=True)
class Pieces:
    """`N` pieces of `K` steps: ``states`` and ``values`` (`V` there) at their ends, ``(K + 1, N, d)`` and ``(K + 1, N)``, the
    mean running ``costs`` in each step ``(K, N)``, and the running cost at the very end, ``last`` ``(N,)``."""

    states: Tensor
    values: Tensor
    costs: Tensor
    last: Tensor


def roll(problem: Problem, value: Field, x: Tensor, pace: Pace, steps: int, generator: torch.Generator) -> Pieces:
    """Pieces of ``steps`` steps from ``x`` ``(N, d)``, with the control of ``value`` held in each; ``generator`` draws noise.

    The state cost of a step is the mean of those at its ends, exact to second order.
    """
    policy, cost = HeldPolicy(problem, value, pace), problem.control_cost
    states, values, costs = [x], list[Tensor](), list[Tensor]()
    with torch.no_grad():
        at = Samples.live(problem, x)
    for k in range(steps + 1):
        with torch.no_grad():
            values.append(value(at.x))
            u, moved = policy.step(at.x)
            spent = cost.cost(u)
            if k == steps:
                return Pieces(torch.stack(states), torch.stack(values), torch.stack(costs), at.f + spent)
            x = at.x + (pace.move(problem, at.x, u) if moved is None else moved)
            if at.noise is not None:
                drawn = torch.randn(len(x), at.noise.shape[-1], generator=generator).to(x)
                x = x + math.sqrt(pace.step) * torch.einsum("ndk,nk->nd", at.noise, drawn)
            before, at = at.f, Samples.live(problem, x.remainder(1.0))
        costs.append(0.5 * (before + at.f) + spent)
        states.append(at.x)
    raise AssertionError("unreachable")


def lambda_returns(costs: Tensor, values: Tensor, discount: float, step: float, trace: float) -> Tensor:
    r"""Estimates of `V` at the start of each step ``(K, N)``, from mean running costs ``(K, N)`` and `V` ``(K + 1, N)``:

        y_k = (1 - g) c_k + g ((1 - trace) V(x_{k+1}) + trace y_{k+1}),   g = e^{-rho step},   y_K = V(x_K),

    the `TD(lambda)` of Sutton for a `V` that is `rho` times an integral. With a ``trace`` of 1 costs alone count up to the
    end, with 0 only those of one step. Unbiased where there is noise, since it is linear in what is drawn.
    """
    kept, y = math.exp(-discount * step), values[-1]
    found: list[Tensor] = []
    for cost, V in zip(reversed(_rows(costs)), reversed(_rows(values)[1:]), strict=True):
        y = (1.0 - kept) * cost + kept * ((1.0 - trace) * V + trace * y)
        found.append(y)
    return torch.stack(found[::-1])


def _rows(of: Tensor) -> Sequence[Tensor]:
    return of.unbind(0)
