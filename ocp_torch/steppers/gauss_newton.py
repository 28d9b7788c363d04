r"""Gauss-Newton steps for one scalar perceptron, on the squares of a residual `r` of its value and gradient at each state.

With the Jacobian `J` of the residuals of a batch in all weights, a step is

    phi_k = m phi_{k-1} + J^T (J J^T + l I)^{-1} (r - m J phi_{k-1}),   theta_{k+1} = theta_k - phi_k :

of all changes that take the residuals of the batch to 0, as far as they are linear, the one nearest to `m` times the change
before (SPRING: Goldshlager, Abrahamsen and Lin, 2024). The system has a row for each state, and `J J^T` is computed without
`J` (`ReverseSweep.products`). Where the solution is smooth this converges geometrically: in 16 coordinates the slack is 2e-4
of the cost after 300 steps of SOAP, 2e-6 after 40 of these, which take half as long.
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
STEP_STATES = 1024
# The damping `l`, relative to the mean diagonal of `J J^T`, by the largest number of coordinates it is for: with 1e-7 eight
# take 25 steps, not 36; one and two take no fewer, and residuals may grow tenfold at first.
DAMPING = {2: 1e-6, math.inf: 1e-7}
# The momentum `m`: with none there is hardly any convergence, with .9 it is no faster.
MOMENTUM = 0.8
# Length of the change of the weights by which `J phi` is computed as a difference.
DIFFERENCE = 1e-3
# Residuals of smooth solutions grow up to threefold at first. Beside a kink the first step makes them a hundred times as
# large, and no other is made.
LARGEST_GROWTH = 10.0
# At this step residuals of smooth solutions had fallen to .5 or less of what they were, in 1 to 64 coordinates; with
# kinks in 5 and 6 they stayed at .8 or more.
CHECKED_STEP = 12
FALLEN_TO = 0.6
PATIENCE = 6  # steps without progress in a row after which they end
PROGRESS = 0.9  # a residual below this part of the smallest so far

# After these steps the residual may be small in the mean and large at a few states. Rounds of steps on batches with the worst
# states follow: in 16 coordinates the largest slack was 7e-3 before, 1e-5 after three.
ROUNDS = 16  # at most
ROUND_STEPS = 2
PEAK_FACTOR = 20.0  # largest residual at which rounds end, relative to what is enough in the mean
# Of all rounds the best is kept, by the mean plus this part of the largest residual: the weight of a spike in a bound, where
# the residual of a fitted density is a few thousandths.
PEAK_WEIGHT = 1e-3

Residual = Callable[[Samples, Jet], Tensor]
# Makes samples at a number of states, among them the given ones, if any.
Draw = Callable[[int, Tensor | None], Samples]
# Finds the states ``(K, d)`` at which the residual of a network is largest, and its largest size.
Worst = Callable[[PeriodicMLP], tuple[Tensor, float]]


class GaussNewton:
    """Steps of the float64 ``network``, whose weights need no gradients, on the squares of ``residual`` ``(N,)``."""

    def __init__(self, network: PeriodicMLP, residual: Residual) -> None:
        self.network, self.residual = network, residual
        self.weights: list[Any] = list(network.parameters())
        self.momentum: list[Any] | None = None

    @torch.no_grad()
    def step(self, samples: Samples) -> float:
        """Make a step on ``samples``. Returns the root mean square of their residuals before it; infinity where the system is
        not positive definite, and no step is made."""
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
        """`J phi` ``(N,)`` of the last change `phi` of the weights, by a central difference."""
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
    """The refined ``network``, and the root mean square of its ``residual`` at states that no step was made on."""

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
    """``network`` after at most ``steps`` steps, in float64 on the CPU, on samples that ``draw`` makes: fewer where the root
    mean square of the residual falls below ``enough``, and then rounds with its ``worst`` states, where these are given.
    `None` where it does not fall to half of what it was, or where told to ``stop``."""
    own = copy.deepcopy(network).to("cpu").double().requires_grad_(False)
    judged = draw(STEP_STATES, None)
    size = lambda: float(residual(judged, own.jet(judged.x)).square().mean().sqrt())
    before, stepper = size(), GaussNewton(own, residual)
    least, since = math.inf, 0
    for k in range(steps):
        seen = math.inf if stop() else stepper.step(draw(STEP_STATES, None))
        if not seen < before * (FALLEN_TO if k == CHECKED_STEP else LARGEST_GROWTH):
            return None
        least, since = (seen, 0) if seen < PROGRESS * least else (least, since + 1)
        if seen < enough or (since >= PATIENCE and k > CHECKED_STEP):
            break
    stepper.momentum, after, least = None, size(), math.inf
    kept = copy.deepcopy(own.state_dict())
    for k in range(ROUNDS + 1):
        if worst is None:
            break
        states, largest = worst(own)
        mean = size()
        if mean + PEAK_WEIGHT * largest < least:
            least, after, kept = mean + PEAK_WEIGHT * largest, mean, copy.deepcopy(own.state_dict())
        if largest <= PEAK_FACTOR * enough or k == ROUNDS:
            break
        for _ in range(ROUND_STEPS):
            if stop() or not math.isfinite(stepper.step(draw(STEP_STATES, states))):
                return None
    own.load_state_dict(kept)
    return Refined(own.to(next(network.parameters())), after) if after < 0.5 * before else None
