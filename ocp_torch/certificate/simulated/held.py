r"""The simulation of a controller whose control is held for a while.

Trajectories are smooth within each hold, so that no step need be halved because a control jumps. But holds are many, some
`12 / (rho h)` to the end of the discount, and choosing a control takes longer than moving under it. Late costs count little,
so that of each set of starts ever fewer are followed: half as many after each discount time. The first points of a
randomised Sobol sequence are spread as the whole set is, so that the sum of means stays unbiased.

For any `V`, the cost of a piece of length `T`, less `V` at its start and plus `e^{-rho T} V` at its end, discounted and
summed over all pieces, is the cost less `V(x_0)`: the better `V`, the less this scatters, however `V` changes in between.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.simulated.loops import HeldLoop
from ocp_torch.certificate.statistics.estimate import Estimate
from ocp_torch.compute.threads import in_pieces
from ocp_torch.maths.jets import Field
from ocp_torch.maths.runge_kutta import (
    AUDIT_FACTOR,
    AUDITED,
    GOOD_PART,
    MAX_DOUBLINGS,
    Switched,
    discounted_integral,
)

# Trajectories of each set at least that are followed to the end: of 256 so few are left for a hundredth of the discount.
FEWEST_FOLLOWED = 8
# Halving the steps goes on while it reduces the error to this part: where trajectories part at a jump it does not.
SMALLER = 0.5


@dataclass(frozen=True)
class Thinning:
    """``count`` trajectories in each of some sets, one set after the other, and how long each is followed: for as many
    ``pieces`` of ``holds`` holds as `kept` says."""

    count: int
    pieces: int
    holds: int

    @classmethod
    def of(cls, loop: HeldLoop, count: int, horizon: float) -> "Thinning":
        """A piece is a discount time, and together they are at least the ``horizon``."""
        holds = max(1, round(1.0 / (loop.problem.discount * loop.hold)))
        return cls(count, math.ceil(horizon / (holds * loop.hold)), holds)

    def kept(self, piece: int) -> int:
        """How many of each set go on with ``piece``."""
        return max(min(FEWEST_FOLLOWED, self.count), self.count >> piece)

    def integrals(
        self, loop: HeldLoop, value: Field | None, state: Tensor, rows: Tensor, substeps: int, together: bool
    ) -> tuple[Tensor, Tensor]:
        """What ``rows`` ``(n,)`` of all trajectories, from ``state`` ``(n, d + m)``, contribute to the mean discounted cost,
        or to its excess over ``value``, and their ends; pieces that only a part of a set follows have more weight."""
        worth = (lambda at: 0.0) if value is None else (lambda at: value(at[:, : loop.problem.dim].remainder(1.0)))
        rho, switched, steps = loop.problem.discount, Switched(loop, loop.renewed, self.holds), self.holds * substeps
        duration, total, end = self.holds * loop.hold, torch.zeros_like(state[:, 0]), state.clone()
        for piece in range(self.pieces):
            on = (rows % self.count < self.kept(piece)).nonzero().squeeze(-1)
            if not len(on):
                break
            part = lambda n: discounted_integral(switched, end[n], rho, duration, steps, wrap=False)
            paid, after = in_pieces(part, on, together, long=True)
            paid = paid - worth(end[on]) + math.exp(-rho * duration) * worth(after)
            total[on] += self.count / self.kept(piece) * math.exp(-rho * piece * duration) * paid
            end[on] = after
        return total, end


def held_integrals(
    loop: HeldLoop,
    quick: HeldLoop,
    value: Field | None,
    state: Tensor,
    mass: Tensor,
    replicates: int,
    horizon: float,
    tolerance: float,
    generator: torch.Generator,
    together: bool,
) -> tuple[Tensor, Tensor, float]:
    """Contributions to the mean by ``mass`` ``(N,)`` of the discounted cost up to the ``horizon`` at least, or of its excess
    over ``value``, from ``state`` ``(N, d + m)``, ``replicates`` sets one after the other; end states; and a bound on the
    error of that mean: the change on a random few by finer steps, and by ``loop`` where ``quick`` rounds. Steps are halved
    until that is below ``tolerance`` or little beside the standard error, or does not get smaller."""
    thinning = Thinning.of(loop, len(mass) // replicates, horizon)
    picked = torch.randperm(len(mass), generator=generator)[:AUDITED]
    substeps, before = loop.substeps, math.inf
    for _ in range(MAX_DOUBLINGS + 1):
        result, end = thinning.integrals(quick, value, state, torch.arange(len(mass)), substeps, together)
        finer, _ = thinning.integrals(loop, value, state[picked], picked, AUDIT_FACTOR * substeps, together)
        missed = mass[picked] * (finer - result[picked])
        bias = abs(float(missed.mean())) + 2.0 * float(missed.std(correction=0)) / math.sqrt(len(missed))
        error = Estimate.of((mass * result).unflatten(0, (replicates, -1)).mean(dim=1).tolist()).se
        if bias <= max(tolerance, GOOD_PART * error) or bias > SMALLER * before:
            break
        substeps, before = 2 * substeps, bias
    return result, end, bias
