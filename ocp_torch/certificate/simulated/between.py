"""What the steps of a simulation jump over: a wall in the drift or the controller, or a place without noise, so thin that no
state of a path is in it. Halved steps jump over it as well, and agree; the true path stays there.

On a few paths, random states between each step and the next are checked. Where a coordinate moves steadily before and after,
but stands still or turns back there, a path cannot pass.
"""

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.nn.functional import max_pool1d

from ocp_torch.certificate.simulated.loops import HeldLoop, Loop
from ocp_torch.certificate.simulated.steps import Steps
from ocp_torch.maths import brownian, runge_kutta
from ocp_torch.maths.runge_kutta import Switched
from ocp_torch.maths.seeds import Branch, derive_seed, fixed_generator
from ocp_torch.maths.supremum import batched
from ocp_torch.problems.blame import place
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.replaced import replaced

CHECKED_PATHS = 64
# States checked on each step: on steps of a fiftieth of a turn 20 of the paths show a wall a thousandth of a turn thick.
STATES_ON_STEP = 8
AROUND = 4  # ends of steps before and after a step between which the motion must be steady
# Part of the fastest speed that the slowest must exceed there, and of the velocity that its change must stay below.
STEADY = 0.5
STILL = 0.05  # a speed of at most this part of the slowest around is as good as standing still
AT_REST = 1e-5  # turns that a moving coordinate exceeds in a step


def jumped_over(loop: Loop, steps: Steps, state: Tensor, taken: Tensor, seed: int) -> str:
    """What a few of the paths of ``loop`` from ``state`` ``(N, k)``, by ``taken`` ``(N,)`` steps, jump over, in words: where
    the velocity of a coordinate without noise turns back, or noise ends; empty where nothing is seen."""
    problem = loop.problem
    generator = torch.Generator().manual_seed(derive_seed(seed, Branch.AUDIT, 1))
    rows = torch.randperm(len(state), generator=generator)[:CHECKED_PATHS]
    spread = lambda states: loop.noise(states)[:, : problem.dim].norm(dim=-1)
    turns, ends = "the velocity is 0 or has the other sign", "there is no noise"
    speeds: dict[str, Callable[[Tensor], Tensor]] = {}
    if not problem.noisy:
        speeds[turns] = lambda states: loop(states)[0][:, : problem.dim]
    elif problem.scan_factor:  # problems of the package have neither walls nor such noise
        if bool((spread(state[rows]) == 0.0).any()):
            speeds[turns] = lambda states: loop(states)[0][:, : problem.dim] * (spread(states) == 0.0)
        if replaced(problem, "noise", Problem):
            speeds[ends] = spread
    for path in _paths(loop, steps, state[rows], taken[rows] * steps.multiples[rows], seed) if speeds else ():
        for what, speed in speeds.items():
            if (x := stopped(speed, path)) is not None:
                return f"at {place(x)}, which steps of simulated paths jump over, {what}: paths may end there"
    return ""


def _paths(loop: Loop, steps: Steps, state: Tensor, taken: Tensor, seed: int) -> Iterator[Tensor]:
    """Paths ``(K + 1, n, k)`` from ``state`` ``(n, k)``, one batch for each number of steps ``taken`` ``(n,)``; with a held
    control, whose steps are many, for a discount time only."""
    horizon, rho = steps.horizon, loop.problem.discount
    for count in map(int, taken.unique()):
        at = state[taken == count]
        if loop.problem.noisy:
            grid = brownian.Grid(torch.full_like(at[:, 0], horizon), count, steps.grading)
            yield brownian.path_of(steps.taken_by(loop), loop.noise, at, grid, seed)
        elif isinstance(loop, HeldLoop):
            holds = min(steps.renewals, math.ceil(1.0 / (rho * loop.hold)))
            switched = Switched(loop, loop.renewed, holds)
            yield runge_kutta.path_of(switched, at, holds * loop.hold, holds * (count // steps.renewals))
        else:
            yield runge_kutta.path_of(loop, at, horizon, count, steps.grading)


@torch.no_grad()
def stopped(speed: Callable[[Tensor], Tensor], path: Tensor) -> Tensor | None:
    """A state ``(d,)`` between two of ``path`` ``(K + 1, n, k)``, whose first `d` columns move, where a component of
    ``speed`` ``(N, k) -> (N, d)`` is 0 or has the other sign; `None` where there is none."""
    each = lambda states: batched(speed, states.flatten(0, 1)).unflatten(0, states.shape[:2])
    here, generator = each(path), fixed_generator()
    dim = here.shape[-1]
    moved = path[1:, :, :dim] - path[:-1, :, :dim]
    most, least = _around(here), -_around(-here)
    sign = torch.where(least > 0.0, 1.0, -1.0).to(here)
    weakest, strongest = torch.minimum(sign * least, sign * most), torch.maximum(sign * least, sign * most)
    straight = here.diff(dim=0).norm(dim=-1, keepdim=True) < STEADY * here[:-1].norm(dim=-1, keepdim=True)
    steady = straight & (weakest > STEADY * strongest) & (moved.abs() > AT_REST)  # else no chord is near the path
    for _ in range(STATES_ON_STEP if bool(steady.any()) else 0):
        part = torch.rand(*moved.shape[:2], 1, dtype=path.dtype, generator=generator)
        between = path[:-1].clone()
        between[:, :, :dim] += part * moved
        met = steady & (sign * each(between) <= STILL * weakest)
        if bool(met.any()):
            return between[met.any(dim=-1)][0, :dim].remainder(1.0)
    return None


def _around(values: Tensor) -> Tensor:
    """The largest of ``values`` ``(K + 1, n, d)`` within `AROUND` ends of steps before and after each step, ``(K, n, d)``."""
    by_row = values.permute(1, 2, 0).flatten(0, 1).unsqueeze(1)
    found = max_pool1d(by_row, 2 * AROUND, stride=1, padding=AROUND - 1)
    return found.squeeze(1).unflatten(0, values.shape[1:]).permute(2, 0, 1)
