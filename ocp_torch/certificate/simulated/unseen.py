"""What the starts and paths of a simulation may have missed: costly states, and jumps of the cost between starts."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ocp_torch.certificate.simulated.loops import FeedbackLoop, Loop
from ocp_torch.certificate.simulated.paths import Paths
from ocp_torch.certificate.statistics.tails import beyond_largest, unmet
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import batched, supremum
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.starts import initial_points

# Number of the first simulation set in the stream of evaluation points: after those of the bounds.
SIMULATION_REPLICATE = 1000
COMPARED = 2**15  # states to whose mean cost that of the starts is compared
UNLIKELY = 2.5  # standard errors between the two means, if that is more than chance
# Factor on their difference, by which the interval is widened: trajectories may stay where no start was.
UNSEEN_ROOM = 2.0
# The largest rate is unmet if all that paths showed is below this part of it,
MET_PART = 0.01
# and counts (`unmet`) if that adds this part of the answer: with 2,048 paths where it is 70 times the answer.
MATERIAL = 0.1
# Ascents to the largest rate: if it has no supremum, as `r^-1.6`, they find more than all that could matter.
ASCENTS = 32
# Paths from states around those of the largest results, and as many around the highest peak of the rate: so many neighbours
# of each, at random distances in turns. On a torus the largest of these results was 7.0e-3, of 16,384 random ones 6.4e-3, of
# the 2,048 of a simulation 2.4e-3.
TOP, NEIGHBOURS = 16, 16
NEAREST, FARTHEST = 1e-4, 3e-2
RESULT_ROOM = 2.0  # head-room on the largest result found,
# which need be known to this part of the largest one met alone: on a torus in a third of the time, the same to .4 %.
RESULT_PART = 0.02


@torch.no_grad()
def unseen_cost(problem: Problem, x0: Tensor, mass: Tensor, seed: int) -> float:
    """The difference of `E[f mu0]` over the starts ``x0`` ``(N, d)`` with their ``mass`` from that over many more states,
    where it is more than chance, else 0: a spike or a hole of `f` that no start has met, or that too few have."""
    if not problem.scan_factor:
        return 0.0
    x, weight = initial_points(problem, COMPARED, SIMULATION_REPLICATE - 1, seed)
    seen, there = mass * problem.state_cost(x0), weight * problem.state_cost(x)
    noise = math.hypot(float(seen.std()) / math.sqrt(len(seen)), float(there.std()) / math.sqrt(len(there)))
    off = abs(float(seen.mean() - there.mean()))
    return off if off > UNLIKELY * noise + 1e-9 * float(there.abs().mean()) else 0.0


def largest_rate_of(loop: Loop) -> float:
    """The largest absolute rate of ``loop`` at evenly spread states."""
    return float(batched(*_rate(loop)).max())


def _rate(loop: Loop) -> tuple[Callable[[Tensor], Tensor], Tensor]:
    """The absolute rate of ``loop`` as a function of the state, and evenly spread states."""
    x = scrambled_sobol(COMPARED, loop.problem.dim, 0, torch.float64)
    return lambda at: loop(loop.start(at))[1].reshape(len(at), -1)[:, 0].abs(), x


def unmet_cost(loop: Loop, met: float, draws: int, size: float) -> float:
    """What states whose rate of cost is far above ``met``, the largest that ``draws`` paths or random times showed, may add
    to the mean, whose size is ``size``; 0 where that is little."""
    if not loop.problem.scan_factor:
        return 0.0
    dearest = largest_rate_of(loop)
    added = unmet(dearest, draws)
    return added if met < MET_PART * dearest and added > MATERIAL * size else 0.0


def unmet_tail(paths: Paths, results: Tensor, size: float) -> float:
    """What results larger than any of ``results`` ``(N,)`` of ``paths`` add to their mean, whose size is ``size``.

    The estimate is `beyond_largest`, but at most what `3 / N` of all paths add if their results are as large as the largest
    found: beside kinks of `V` errors fall off slowly, but only up to that one."""
    beyond = beyond_largest(results, paths.mass, size)
    if not beyond > 0.0:
        return 0.0
    largest = largest_result_of(paths, results) + abs(float(paths.means(results).mean()))
    return min(beyond, unmet(float(paths.mass.max()) * largest, len(results)))


@torch.no_grad()
def largest_result_of(paths: Paths, results: Tensor) -> float:
    """The largest absolute result of paths, of which those of ``paths`` are ``results`` ``(N,)``: of these, and of others
    that start near the largest and near the highest peak of the rate. Where paths are random, or a control is held, no result
    is larger than that peak, with the variate."""
    loop, met, dim = paths.loop, float(results.abs().max()), paths.loop.problem.dim
    peak = supremum(*_rate(paths.quick), ASCENTS, differentiable=False)
    if loop.problem.noisy or paths.times is not None or not isinstance(loop, FeedbackLoop):
        along = 0.0 if paths.value is None else float(paths.value(paths.state[:, :dim]).abs().max())
        return max(peak.value, met) + along
    top = paths.state[results.abs().topk(min(TOP, len(results))).indices, :dim]
    starts = torch.cat([top, peak.x.expand(TOP, -1)]).repeat(NEIGHBOURS, 1)
    generator = fixed_generator()
    radius = NEAREST * (FARTHEST / NEAREST) ** torch.rand(len(starts), 1, generator=generator, dtype=starts.dtype)
    around = starts + radius * torch.randn(starts.shape, generator=generator, dtype=starts.dtype)
    found = paths.from_states(torch.cat([peak.x.expand(2, -1), around]).remainder(1.0), RESULT_PART * met)
    return RESULT_ROOM * max(float(found.abs().max()), met)


def stratum_error(results: Tensor, replicates: int) -> float:
    """The standard error of a mean of ``results`` ``(N,)``, of ``replicates`` of evenly spread starts, if one stratum is off.

    Where the cost jumps, all replicates may put the start of the stratum with the jump on the same side, and then agree with
    one another. A stratum holds one of the `n` starts of a replicate: its mean is off by the spread of the results over `n`.
    Without this, 95 % intervals missed the mean of a step in 7 to 25 % of draws, whatever `n` from 4 to 256; with it, in 1 to
    7 %.
    """
    return float(results.std()) / (len(results) // replicates * math.sqrt(replicates))
