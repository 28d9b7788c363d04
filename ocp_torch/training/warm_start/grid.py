r"""What the warm start learns where a grid is cheap: `V` at the nodes of a grid of the torus, by dynamic programming.

    V(x) = min_u (1 - g) (f(x) + f(x'))/2 + (1 - g) R(u) + g E V(x'),   g = e^{-rho step},

`x'` where a step under a held `u` leads to, `V(x')` interpolated multilinearly: a contraction, whose minimum is taken over
finitely many `u`. An approximation to learn a controller from, by which no bound is made.
"""

import itertools
import math

import torch
from torch import Tensor

from ocp_torch.control.pace import Pace
from ocp_torch.maths.jets import Field
from ocp_torch.maths.supremum import batched
from ocp_torch.problems import Problem
from ocp_torch.problems.simulator.simulator import Simulator
from ocp_torch.training.warm_start.targets import Targets

# On a limited pendulum (discount 0.5) a controller from this grid costs 2.974, one from trajectories 3.06 in twice the time.
DIM = 2
SIDE = 192  # nodes along each coordinate
CONTROLS = 17  # tried at each node, from one limit to the other
STEP_FACTOR = 1.2  # steps in units of those of the pace: longer ones are interpolated less often
POLICY_SWEEPS = 25  # for which a policy is followed before it is improved
SETTLED_PART = 0.002  # an improvement that moves V by less of its largest value, were it made for ever, is the last
MOST_POLICIES = 200
# The first learning rate of a fit, in units of the usual one, from which it falls to 0: Pendulum-v1 lost 1.6 % of the return
# so, and 4 % at the usual rate throughout.
FIRST_RATE = 2.5


class GridValues:
    """The values at the nodes of a grid, computed once, when they are first asked for."""

    trial_every = 40  # rounds, whose fits take no less time than a trial
    fastest = FIRST_RATE

    def __init__(self, problem: Problem, pace: Pace, like: Tensor) -> None:
        self.problem, self.pace, self.like = problem, pace.with_step(STEP_FACTOR * pace.step), like
        self.asked, self.drawn, self._found = False, 0, list[Targets]()

    @staticmethod
    def suits(problem: Problem) -> bool:
        """Whether a grid is cheap: two coordinates and one control with a limit, of a problem that is no simulator."""
        one = problem.dim == DIM and problem.control_dim == 1
        return one and math.isfinite(problem.control_cost.reach) and not isinstance(problem, Simulator)

    @property
    def plan(self) -> str:
        return f"fits to a grid of {SIDE} x {SIDE} nodes"

    def targets(self, average: Field) -> Targets:
        """All nodes, with the values and their gradients there, whatever the ``average``."""
        self.drawn, self.asked = 0 if self.asked else CONTROLS * SIDE**DIM, True
        if not self._found:
            x, V = self._solved()
            gradients = slopes(V).to(self.like)
            x, V = x.to(self.like), V.to(self.like)
            self._found.append(Targets(x, V, V, gradients))
        return self._found[0]

    @torch.no_grad()
    def _solved(self) -> tuple[Tensor, Tensor]:
        problem, rate = self.problem, -math.expm1(-self.problem.discount * self.pace.step)
        line = torch.arange(SIDE, dtype=torch.float64) / SIDE
        x = torch.cartesian_prod(*[line] * DIM)
        f, reach = batched(problem.state_cost, x), problem.control_cost.reach
        index, weight, cost = [], [], []
        for u in torch.linspace(-reach, reach, CONTROLS, dtype=torch.float64):
            held = u.expand(len(x), 1)
            end = x + self.pace.move(problem, x, held)
            places, parts = stencil(self._kicked(x, end))
            paid = 0.5 * (f + batched(problem.state_cost, end.remainder(1.0)))
            cost.append(rate * (paid + problem.control_cost.cost(held)))
            index.append(places)
            weight.append((1.0 - rate) * parts)
        return x, solved(torch.stack(index), torch.stack(weight), torch.stack(cost), rate)

    def _kicked(self, x: Tensor, end: Tensor) -> Tensor:
        """Equally likely noisy ends ``(J, N, d)`` of a step from ``x`` to ``end``, right in mean and covariance."""
        sigma = self.problem.noise(x)
        if sigma is None:
            return end.unsqueeze(0)
        kicks = math.sqrt(sigma.shape[-1] * self.pace.step) * sigma.permute(2, 0, 1)
        return torch.cat([end + kicks, end - kicks])

    def state_dict(self) -> dict:
        return {"asked": self.asked}

    def load_state_dict(self, state: dict) -> None:
        """Restore what `state_dict` gave: values are computed anew, but their states are not counted again."""
        self.asked = bool(state["asked"])


def slopes(V: Tensor) -> Tensor:
    """The gradient ``(N, d)`` at all nodes, by central differences, of the function with the values ``V`` ``(N,)`` there."""
    cube = V.reshape((SIDE,) * DIM)
    return torch.stack([0.5 * SIDE * (cube.roll(-1, k) - cube.roll(1, k)) for k in range(DIM)], dim=-1).flatten(0, -2)


def stencil(points: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights ``(N, 2^d J)`` that interpolate the mean over the ``points`` ``(J, N, d)`` multilinearly."""
    place = points * SIDE
    base = place.floor()
    part = place - base
    index, weight = [], []
    for corner in itertools.product((0, 1), repeat=points.shape[-1]):
        at = torch.tensor(corner)
        flat = torch.zeros_like(points[..., 0], dtype=torch.long)
        for node in (base.long() + at).remainder(SIDE).unbind(-1):
            flat = flat * SIDE + node
        index.append(flat)
        weight.append(torch.where(at.bool(), part, 1.0 - part).prod(dim=-1) / len(points))
    return torch.cat(index).T.contiguous(), torch.cat(weight).T.contiguous()


def solved(index: Tensor, weight: Tensor, cost: Tensor, rate: float) -> Tensor:
    """The fixed point ``(N,)`` of `V = min_k cost_k + sum_j weight_kj V(index_kj)`, for ``cost`` ``(K, N)`` and ``index`` and
    ``weight`` ``(K, N, J)``, whose weights add up to ``1 - rate``: by modified policy iteration."""
    V, rows = torch.zeros_like(cost[0]), torch.arange(cost.shape[1])
    for _ in range(MOST_POLICIES):
        values = torch.stack([c + (w * V[i]).sum(dim=-1) for c, w, i in zip(cost, weight, index, strict=True)])
        best, policy = values.min(dim=0)
        moved, V = float((best - V).abs().max()), best
        if moved <= SETTLED_PART * rate * float(V.abs().max()):
            break
        c, w, i = (of[policy, rows] for of in (cost, weight, index))
        for _ in range(POLICY_SWEEPS):
            V = c + (w * V[i]).sum(dim=-1)
    return V
