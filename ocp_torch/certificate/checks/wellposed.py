"""Is the problem what every bound takes it for? Periodic, with `f >= 0` and a probability density `mu0`."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ocp_torch.certificate.statistics.estimate import Estimate, integral
from ocp_torch.errors import ProblemError
from ocp_torch.maths.mixtures import effective_part
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.maths.seeds import fixed_generator
from ocp_torch.maths.supremum import supremum
from ocp_torch.problems.blame import place
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

PROBES = 256  # states at which the period is checked; a fourth of them at each seam
MOST_SEAMS = 32  # coordinates whose seams are checked
ROUNDING = 1e-6  # relative difference, a period apart, that rounding may explain
SEAM_STEP = 1e-9  # half the width of the gap across which a seam is checked
SEAM_JUMP = 1e-5  # relative difference across that gap that is no jump
# How far the sampled mass of mu0 may be from 1, beside its confidence interval at `MASS_LEVEL`.
MASS_TOLERANCE = 1e-4
MASS_LEVEL = 0.9999
# Effective part of the sampled states that carry mu0 (`effective_part`), below which its mass is not known.
LEAST_WORTH = 0.02
DESCENTS = 16  # lowest states from which a negative value of a function is sought downhill
DESCENT_STEPS = 40
# The columns of samples, and the functions that give them.
NAMES = {"f": "state_cost", "a": "drift", "B": "control_matrix", "mu0": "initial_density", "noise": "noise"}
DIFFERENTIATED = {"a", "B", "noise"}  # by the bounds that take divergences


@dataclass(frozen=True)
class WellPosed:
    """What was found: ``sound`` where the problem is well posed (every bound needs it), ``nonnegative`` where `f >= 0` (`J`
    and `G` need it), ``smooth_seam`` where `a`, `B` and the noise do not jump from 1 to 0 (bounds that take their divergence
    need it)."""

    sound: bool
    nonnegative: bool
    smooth_seam: bool
    smallest_cost: float
    mass: float
    warnings: list[str]


@torch.no_grad()
def check_problem(problem: Problem, sets: list[Samples], odd: Callable[[], Tensor | None] = lambda: None) -> WellPosed:
    """Compare values a period apart, on both sides of the seam, and against 0 and 1; on ``sets`` and climbed from there, and
    at the states ``odd()`` ``(K, d)``, which are computed once all is known to be finite.

    Raises `ProblemError` where a function is not finite.
    """
    _require_finite(sets)
    columns = [_columns(samples) for samples in sets]
    sizes = {name: max(float(column[name].abs().max()) for column in columns) for name in columns[0]}
    x = scrambled_sobol(PROBES, problem.dim, 2, torch.float64)
    whole_numbers = torch.randint(-2, 4, x.shape, generator=fixed_generator()).to(x)
    shifted = _differences(problem, x, x + whole_numbers, ROUNDING, sizes)
    seams = _seams(problem, sizes)
    narrow = odd()
    smallest = _smallest(problem.state_cost, sets, "f", narrow)
    nonnegative = smallest >= -ROUNDING * sizes["f"]
    mass = Estimate.of([integral(samples, samples.mu0) for samples in sets])
    improper = _improper(mass, _smallest(problem.initial_density, sets, "mu0", narrow), sets)
    warnings = [
        *(
            f"no bound is used: {NAMES[name]} is not periodic, it changes by {size:.3g} when whole numbers are added to x."
            for name, size in shifted.items()
        ),
        *(_jump_at_seam(name, size) for name, size in seams.items() if name not in shifted),
        *(
            []
            if nonnegative
            else [f"J and G are not used: the state cost falls to {smallest:.3g}, but they need f >= 0."]
        ),
        *(f"no bound is used: {sentence}." for sentence in improper),
    ]
    return WellPosed(
        sound=not shifted and not improper,
        nonnegative=nonnegative,
        smooth_seam=not DIFFERENTIATED & seams.keys(),
        smallest_cost=smallest,
        mass=mass.value,
        warnings=warnings,
    )


def _require_finite(sets: list[Samples]) -> None:
    for samples in sets:
        for name, column in _columns(samples).items():
            bad = ~torch.isfinite(column).reshape(len(samples), -1).all(dim=-1)
            if bool(bad.any()):
                at = place(samples.x[bad][0])
                raise ProblemError(f"{NAMES[name]} is not finite at {at}; it must be finite on the whole torus.")


def _jump_at_seam(name: str, size: float) -> str:
    cost = ": bounds that take its divergence are not used" if name in DIFFERENTIATED else ", as a function may"
    return f"{NAMES[name]} jumps by {size:.3g} where a coordinate passes from 1 to 0{cost}."


def _improper(mass: Estimate, least: float, sets: list[Samples]) -> list[str]:
    """Why `mu0`, of this ``mass`` and ``least`` value, is no probability density, or cannot be known to be one."""
    found = []
    if not least >= -ROUNDING * abs(mass.value):
        found.append(f"the initial density falls to {least:.3g}, but must not be negative")
    carried = effective_part(torch.cat([s.weight * s.mu0 for s in sets]).clamp_min(0.0))
    if not abs(mass.value - 1.0) <= MASS_TOLERANCE + mass.half_width(MASS_LEVEL):
        found.append(
            f"the initial density integrates to {mass.value:.4g} over what a search found of it, but must to 1"
        )
    elif carried < LEAST_WORTH:
        found.append(
            "hardly any sampled state carries mass of the initial density, which is too narrow for its integral to be known "
            f"(all states are worth as much as {100.0 * carried:.2g} % of them)"
        )
    return found


def _differences(problem: Problem, x: Tensor, y: Tensor, tolerance: float, sizes: dict[str, float]) -> dict[str, float]:
    """The largest difference of each function between rows of ``x`` and ``y``, where it is above the part ``tolerance`` of
    its largest value anywhere (``sizes``), as an odd function is nearly 0 at the seam."""
    here, there = (_columns(Samples.of(problem, z, divergences=False)) for z in (x, y))
    found = {}
    for name, left in here.items():
        right = there[name]
        size = float((left - right).abs().max())
        if not size <= tolerance * max(sizes[name], float(left.abs().max()), float(right.abs().max())):
            found[name] = size
    return found


def _seams(problem: Problem, sizes: dict[str, float]) -> dict[str, float]:
    found: dict[str, float] = {}
    for i in range(min(problem.dim, MOST_SEAMS)):
        after = scrambled_sobol(PROBES // 4, problem.dim, 3 + i, torch.float64)
        after[:, i] = SEAM_STEP
        before = after.clone()
        before[:, i] = 1.0 - SEAM_STEP
        for name, size in _differences(problem, after, before, SEAM_JUMP, sizes).items():
            found[name] = max(size, found.get(name, 0.0))
    return found


def _columns(samples: Samples) -> dict[str, Tensor]:
    """The columns that `NAMES` lists; for the noise `sigma sigma^T`, on which alone the law of a path depends."""
    found = {name: getattr(samples, name) for name in NAMES}
    return {name: c @ c.mT if name == "noise" else c for name, c in found.items() if c is not None}


def _smallest(function, sets: list[Samples], name: str, odd: Tensor | None) -> float:
    """The smallest value of ``function``: on ``sets``, at ``odd`` states, and downhill from the lowest of all."""
    values, states = torch.cat([getattr(s, name) for s in sets]), torch.cat([s.x for s in sets])
    if odd is not None and len(odd):
        values, states = torch.cat([values, function(odd)]), torch.cat([states, odd])
    lowest = states[values.topk(min(DESCENTS, len(values)), largest=False).indices]
    found = supremum(lambda x: -function(x), lowest, DESCENTS, DESCENT_STEPS, differentiable=False)
    return min(-found.value, float(values.min()))
