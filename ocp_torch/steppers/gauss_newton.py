r"""Gauss-Newton steps for one scalar perceptron: the squares of a residual `r` of its value and gradient at each state.

With the Jacobian `J` of the residuals of a batch in all weights, a step is

    phi_k = m phi_{k-1} + J^T (J J^T + l I)^{-1} (r - m J phi_{k-1}),   theta_{k+1} = theta_k - phi_k :

the change that takes all residuals of the batch to 0, as far as they are linear, and is nearest to the one before (SPRING:
Goldshlager, Abrahamsen and Lin, 2024). The system has a row for each state, and `J J^T` is had without `J`
(`ReverseSweep.products`). Where the solution is smooth this converges geometrically: 16 coordinates have a slack of 2e-4 of
the cost after 300 steps of SOAP, of 2e-6 after 40 of these, which take half as long.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ocp_torch.fields.mlp import PeriodicMLP
from ocp_torch.fields.reverse_sweep import ReverseSweep
from ocp_torch.maths.jets import Jet
from ocp_torch.problems.samples import Samples

# States of a step: in 64 coordinates steps on 512 diverge, on 1,024 they converge.
STATES = 1024
# The damping `l` relative to the mean of the diagonal, up to so many coordinates: with 1e-3 convergence is several times
# slower; with 1e-6 four, eight and sixteen coordinates take 42, 36 and 32 steps, with 1e-7 30, 25 and 24 (one seed each). One
# and two coordinates take no fewer, and in one, with 24 units to a layer, the first steps make residuals ten times as large.
DAMPING = {2: 1e-6, math.inf: 1e-7}
# The momentum `m`: with none there is hardly any convergence, with .9 it is no faster.
MOMENTUM = 0.8
# The length of the difference by which `J phi` is computed, relative to that of `phi`.
DIFFERENCE = 1e-3
# Residuals of smooth solutions grow at first, up to threefold. Beside a kink, which no smooth function has, the first step
# makes them a hundred times as large: then there are no more.
GROWTH = 10.0
# After so many steps those of smooth solutions had fallen to between .08 and .5 of what they were, in 1 to 64 coordinates;
# with kinks in 5 and 6, where none grows as much, they stayed at .8 to 1.1 for as long as there were steps.
LOOKED_AT, FALLEN = 12, 0.6
# Later on steps end where so many in a row have not made the residual smaller than that part of the smallest so far.
PATIENCE, SMALLER = 6, 0.9

# A residual that is small in the mean is large at a few states, where weights that were moved far bend the network over a
# short way: then come so many rounds of so many steps on batches with the worst states that are found, until these are no
# more than so many times what is enough in the mean. Of 16 coordinates the largest slack was 7e-3 before, and 1e-5 after
# three. Of 64 the first steps make the mean of 5e-6 forty times as large, and later ones take it back: of a largest one of .7
# 1.4e-3 was left after eight rounds, with a mean of 2e-5; of one of 2.0, met with other states, 2e-3 and 3e-6 after sixteen.
ROUNDS, ROUND_STEPS, PEAK = 16, 2, 20.0
# What is kept is the best of all rounds, by the mean and that part of the largest, which is what spikes add to a bound: the
# residual of a density that was fitted is a few thousandths.
SPIKES = 1e-3

Residual = Callable[[Samples, Jet], Tensor]


# Samples at so many states, among which are those that are given, if any.
Draw = Callable[[int, Tensor | None], Samples]
# The states found at which the residual of a network is largest, ``(K, d)``, and how large it is there.
Worst = Callable[[PeriodicMLP], tuple[Tensor, float]]


class GaussNewton:
    """Steps of ``network``, in float64 and frozen, on the squares of ``residual`` ``(N,)`` of samples and the jet there."""

    def __init__(self, network: PeriodicMLP, residual: Residual) -> None:
        self.network, self.residual = network, residual
        self.weights: list[Any] = list(network.parameters())
        self.momentum: list[Any] | None = None

    @torch.no_grad()
    def step(self, samples: Samples) -> float:
        """One step on ``samples``; the root mean square of their residuals before it, infinite where none could be made."""
        sweep = ReverseSweep(self.network, samples.x)
        with torch.enable_grad():
            jet = Jet(*(part.requires_grad_(True) for part in sweep.jet()))
            residual = self.residual(samples, jet)
            slopes = torch.autograd.grad(residual.sum(), (jet.value, jet.gradient))
        residual = residual.detach()
        sweep.turn(*slopes)
        gram = sweep.products()
        damping = next(part for most, part in DAMPING.items() if samples.x.shape[1] <= most)
        gram.diagonal().add_(damping * gram.diagonal().mean())
        wanted = residual if self.momentum is None else residual - MOMENTUM * self._along(samples)
        factor, failed = torch.linalg.cholesky_ex(gram)
        if failed:
            return math.inf
        each = torch.cholesky_solve(wanted.unsqueeze(-1), factor).squeeze(-1)
        sweep.turn(each * slopes[0], each.unsqueeze(-1) * slopes[1])
        move = sweep.slopes()
        if self.momentum is not None:
            torch._foreach_add_(move, self.momentum, alpha=MOMENTUM)
        torch._foreach_sub_(self.weights, move)
        self.momentum = move
        return float(residual.square().mean().sqrt())

    def _along(self, samples: Samples) -> Tensor:
        """`J phi` ``(N,)`` of the last move `phi`, by a difference."""
        assert self.momentum is not None  # else there was none
        length = DIFFERENCE / max(float(torch.nn.utils.get_total_norm(self.momentum)), 1e-300)
        ends = []
        for way in (length, -2.0 * length):
            torch._foreach_add_(self.weights, self.momentum, alpha=way)
            ends.append(self.residual(samples, self.network.jet(samples.x)))
        torch._foreach_add_(self.weights, self.momentum, alpha=length)
        return (ends[0] - ends[1]) / (2.0 * length)


@dataclass(frozen=True)
class Refined:
    """What steps led to: the ``network``, and the root mean square of its ``residual`` at states that none was made on."""

    network: PeriodicMLP
    residual: float


def refined(
    network: PeriodicMLP,
    residual: Residual,
    draw: Draw,
    steps: int,
    enough: float = 0.0,
    stop: Callable[[], bool] = lambda: False,
    worst: Worst | None = None,
) -> Refined | None:
    """``network`` after at most so many ``steps`` on samples ``draw(count, also)``, in float64 on the CPU, fewer where the
    residual falls below ``enough``, and after more with the ``worst`` states among them; `None` where the residual does not
    fall to half of what it was, or where told to ``stop``."""
    own = copy.deepcopy(network).to("cpu").double().requires_grad_(False)
    judged = draw(STATES, None)
    size = lambda: float(residual(judged, own.jet(judged.x)).square().mean().sqrt())
    before, stepper = size(), GaussNewton(own, residual)
    least, since = math.inf, 0
    for k in range(steps):
        seen = math.inf if stop() else stepper.step(draw(STATES, None))
        if not seen < before * (FALLEN if k == LOOKED_AT else GROWTH):
            return None
        least, since = (seen, 0) if seen < SMALLER * least else (least, since + 1)
        if seen < enough or (since >= PATIENCE and k > LOOKED_AT):
            break
    stepper.momentum, after, least = None, size(), math.inf
    kept = copy.deepcopy(own.state_dict())
    for k in range(ROUNDS + 1):
        if worst is None:
            break
        states, largest = worst(own)
        mean = size()
        if mean + SPIKES * largest < least:
            least, after, kept = mean + SPIKES * largest, mean, copy.deepcopy(own.state_dict())
        if largest <= PEAK * enough or k == ROUNDS:
            break
        for _ in range(ROUND_STEPS):
            if stop() or not math.isfinite(stepper.step(draw(STATES, states))):
                return None
    own.load_state_dict(kept)
    return Refined(own.to(next(network.parameters())), after) if after < 0.5 * before else None
