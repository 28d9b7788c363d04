r"""Pieces of trajectory under the greedy controller of a `V`, and what they say of the value of every state on them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.control.greedy import HeldPolicy
from ocp_torch.control.pace import Pace
from ocp_torch.maths.jets import Field
from ocp_torch.problems import Problem
from ocp_torch.problems.samples import Samples


@dataclass(frozen=True)
class Pieces:
    """`N` pieces of `K` steps: ``states`` and ``values`` (`V` there) at their ends, ``(K + 1, N, d)`` and ``(K + 1, N)``, the
    mean running ``costs`` in each step ``(K, N)``, and the running cost at the very end, ``last`` ``(N,)``."""

    states: Tensor
    values: Tensor
    costs: Tensor
    last: Tensor


def roll(problem: Problem, value: Field, x: Tensor, pace: Pace, steps: int, generator: torch.Generator) -> Pieces:
    """From ``x`` ``(N, d)`` for ``steps``, with the control of ``value`` held in each; noise is drawn from ``generator``.

    Of the cost of a step the part of the state is the mean of that at its ends, exact to second order.
    """
    policy, cost = HeldPolicy(problem, value, pace), problem.control_cost
    states, values, costs = [x], list[Tensor](), list[Tensor]()
    with torch.no_grad():
        at = Samples.live(problem, x)
    for k in range(steps + 1):
        with torch.no_grad():
            values.append(value(at.x))
            u = policy(at.x)
            spent = cost.cost(u)
            if k == steps:
                return Pieces(torch.stack(states), torch.stack(values), torch.stack(costs), at.f + spent)
            x = at.x + pace.move(problem, at.x, u)
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
