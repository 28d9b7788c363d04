"""What is observed of a controller: how large it gets, where it leads, and whether it and the problem are regular.

Jumps and layers are found by halving segments until nothing else changes across them.
"""

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from ocp_torch.certificate.simulated.backward import a_priori_sup_occupation, estimated_sup_occupation
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.control.policies import Policy
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import batched
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples, driven

CONTROLLED = 4096  # states of each set at which the size of the control is computed
CROSSED = 256  # states of each set through which lines are drawn in search of jumps
SEGMENTS = 768  # random ones that are halved too
LINES = 48  # of each length, half of them along an axis
LENGTHS = (1.0, 0.1, 0.01, 1e-3)
ON_LINE = 65  # states on a line
FOLLOWED = 64  # pieces of the lines of a length that are halved, for each way to choose them
HALVINGS = 34  # after the last halving the longest segment is 3e-11 long: what still changes across it is no slope
FIRST_HALVINGS = 14  # after which only the segments with the largest changes go on
REMAINING_SEGMENTS = 384
# A change relative to the largest value met that counts as a jump; above the noise of a controller in float32.
NOTICEABLE = 1e-5
# Sampled states see a layer of this width as a jump if this part of the largest value changes across it.
LAYER = 1e-4
LAYER_CHANGE = 0.5

CONTROLLER, DRIFT, MATRIX, NOISE, LOOP = "controller", "drift", "control matrix", "noise", "closed loop"


@dataclass(frozen=True)
class Jump:
    """The largest jump found: its ``size``, `|u(x+) - u(x-)|`, 0 where there is none; a state ``x`` ``(d,)`` next to it; of
    ``what``; and the ``width`` of the segment across which it was seen."""

    size: float
    x: Tensor
    what: str = CONTROLLER
    width: float = 0.0

    @property
    def in_problem(self) -> bool:
        return self.what in (DRIFT, MATRIX, NOISE)

    @property
    def verb(self) -> str:
        return "jumps" if self.width < 0.1 * LAYER else f"changes within {self.width:.1g}"


@dataclass(frozen=True)
class Observed:
    """What the checks found; `None` where a check was not made."""

    sup_occupation: float | None = None
    a_priori_occupation: float | None = None  # >= sup mu^u, by the divergence of the closed loop
    sup_control: float | None = None
    largest_value: float | None = None  # V^u at a simulated start
    jump: Jump | None = None


def observe(
    problem: Problem,
    policy: Policy,
    simulated: Simulated | None,
    sets: list[Samples],
    occupation_states: int,
    together: bool = False,
    jumps: bool = True,
    rounded: Policy | None = None,
) -> Observed:
    """Check the controller ``policy`` at the states of ``sets``, and where the trajectories of ``simulated`` end. Its
    occupation density is computed at so many ``occupation_states``, 0 for not at all, on all cores ``together`` if problem
    and policy are pure functions. Jumps are sought if ``jumps``. ``rounded`` is the policy in single precision, if any."""
    with torch.no_grad():
        sup_control = max(float(policy(samples.x[:CONTROLLED]).norm(dim=-1).max()) for samples in sets)
    near = torch.cat([samples.x[:CROSSED] for samples in sets])
    occupation = a_priori = largest_value = None
    if simulated is not None:
        near, largest_value = torch.cat([near, simulated.end_states[:CONTROLLED]]), simulated.largest_value
        # Where the problem declares mu* unbounded there is no M to compare a largest density with.
        # With noise the density is followed back in time by its divergences.
        followed = problem.gives_divergences or not problem.noisy
        if occupation_states and followed and problem.occupation_bound != math.inf:
            how = occupation_states, together, rounded
            occupation = estimated_sup_occupation(problem, policy, simulated.end_states, *how)
            a_priori = a_priori_sup_occupation(problem, policy, sets[0].x[:CONTROLLED])
    jump = largest_jump(policy, problem.dim, problem=problem, near=near) if jumps else None
    return Observed(occupation, a_priori, sup_control, largest_value, jump)


@torch.no_grad()
def largest_jump(policy: Policy, dim: int, problem: Problem | None = None, near: Tensor | None = None) -> Jump:
    """Follow, on segments of all lengths, the half across which the control changes more; with ``problem`` also its drift,
    control matrix and closed loop, and layers of them too steep for sampled states to resolve.

    Pieces come from random segments and lines, half of these through states of ``near`` ``(N, d)``, on which the pieces that
    change most and most unlike their neighbours are followed. For a Lipschitz function the change halves with the length; a
    jump that is followed stays. One much smaller than what changes nearby anyway, or on a tiny set, can be missed.
    """

    def parts(x: Tensor) -> dict[str, Tensor]:
        """What may jump, each ``(N, k)``; data come first, as a jump of theirs is one of the closed loop too."""
        if problem is None:
            return {CONTROLLER: policy(x)}
        a, B, _, _ = problem.vector_fields(x, divergences=False)
        u, noise = policy(x), problem.noise(x) if problem.noisy else None
        found = {} if problem.driftless else {DRIFT: a}
        found |= {MATRIX: B.flatten(1)} | ({} if noise is None else {NOISE: noise.flatten(1)})
        return found | {CONTROLLER: u, LOOP: driven(a, B, u)}

    generator = fixed_generator()
    draw = partial(torch.rand, dtype=torch.float64, generator=generator)
    left = draw(SEGMENTS, dim)
    direction = normalize(torch.randn(SEGMENTS, dim, dtype=torch.float64, generator=generator))
    right = left + direction * 10.0 ** (-3.0 * draw(SEGMENTS, 1)) * 0.5
    sizes = {name: max(float(part.norm(dim=-1).max()), 1e-300) for name, part in parts(left).items()}
    together = lambda x: torch.cat([part / sizes[name] for name, part in parts(x).items()], dim=-1)
    first, last = _pieces(together, dim, generator, near)
    left, right = torch.cat([left, first]), torch.cat([right, last])
    steepest, steep_at = 0.0, left[0]
    value_left, value_right = batched(together, left), batched(together, right)
    for k in range(HALVINGS):
        middle = 0.5 * (left + right)
        value = batched(together, middle)
        nearer = ((value - value_left).norm(dim=-1) > (value_right - value).norm(dim=-1)).unsqueeze(-1)
        left, value_left = torch.where(nearer, left, middle), torch.where(nearer, value_left, value)
        right, value_right = torch.where(nearer, middle, right), torch.where(nearer, value, value_right)
        change = (value_right - value_left).norm(dim=-1).nan_to_num(nan=0.0)
        narrow = torch.where((right - left).norm(dim=-1) <= LAYER, change, 0.0)
        if float(narrow.max()) > steepest:
            steepest, steep_at = float(narrow.max()), left[int(narrow.argmax())].clone()
        if k == FIRST_HALVINGS:
            top = change.topk(min(REMAINING_SEGMENTS, len(change))).indices
            left, right, value_left, value_right = (part[top] for part in (left, right, value_left, value_right))
    jump = _largest(parts, sizes, left, right, NOTICEABLE)
    if jump.size > 0.0 or problem is None or steepest < LAYER_CHANGE:
        return jump
    away = 0.5 * LAYER * normalize(torch.ones(1, dim, dtype=torch.float64))
    return _largest(parts, sizes, steep_at - away, steep_at + away, 0.5 * LAYER_CHANGE, LAYER)


def _largest(parts, sizes: dict[str, float], left: Tensor, right: Tensor, least: float, width: float = 0.0) -> Jump:
    """The jump of the one of ``parts`` whose change from ``left`` to ``right`` is largest, relative to ``sizes``, and above
    ``least``; a later part must change twice as much as those before."""
    best, relative, before = Jump(0.0, left[0].remainder(1.0)), least, parts(left)
    for name, after in parts(right).items():
        change = (after - before[name]).norm(dim=-1).nan_to_num(nan=0.0)
        worst = int(change.argmax())
        if float(change[worst]) > relative * sizes[name]:
            relative = 2.0 * float(change[worst]) / sizes[name]
            best = Jump(float(change[worst]), left[worst].remainder(1.0), name, width)
    return best


def _pieces(function, dim: int, generator: torch.Generator, near: Tensor | None) -> tuple[Tensor, Tensor]:
    """The ends of pieces of lines across which ``function`` changes most, and most unlike the pieces beside them."""
    draw = partial(torch.rand, dtype=torch.float64, generator=generator)
    starts, ends = [], []
    for length in LENGTHS:
        middle = draw(LINES, dim)
        if near is not None and len(near):
            rows = torch.randint(len(near), (LINES // 2,), generator=generator)
            # At a random place on the line, not always at the same of its states.
            middle[: LINES // 2] = near[rows] + 0.3 * length * (draw(LINES // 2, dim) - 0.5) / dim**0.5
        direction = torch.randn(LINES, dim, dtype=torch.float64, generator=generator)
        axis = torch.randint(dim, (LINES,), generator=generator)
        direction[::2] = one_hot(axis[::2], dim).to(direction)
        along = length * torch.linspace(-0.5, 0.5, ON_LINE, dtype=torch.float64)
        x = middle.unsqueeze(1) + along[:, None] * normalize(direction).unsqueeze(1)  # (LINES, ON_LINE, d)
        step = batched(function, x.flatten(0, 1)).unflatten(0, (LINES, ON_LINE)).diff(dim=1)
        change = step.norm(dim=-1).nan_to_num(nan=0.0)
        unlike = torch.zeros_like(change)
        unlike[:, 1:-1] = (step[:, 1:-1] - 0.5 * (step[:, :-2] + step[:, 2:])).norm(dim=-1).nan_to_num(nan=0.0)
        for score in (change, unlike):
            picked = score.flatten().topk(FOLLOWED).indices
            starts.append(x[:, :-1].flatten(0, 1)[picked])
            ends.append(x[:, 1:].flatten(0, 1)[picked])
    return torch.cat(starts), torch.cat(ends)
