"""Points along the runs of contenders: bounds and performances of their fields at that moment, as in certificates."""

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count, groupby

import torch
from torch import Tensor, nn

from ocp_torch.certificate import BOUNDS, LOWER, UPPER, CertificateSettings, Run, StageSettings, Trained, bounds
from ocp_torch.certificate.bounds.penalised_dual import PenalisedDual
from ocp_torch.certificate.contexts.trained import TrainedContext
from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.certificate.statistics.estimate import replicated_samples
from ocp_torch.certificate.upper.penalised import DensityBounds
from ocp_torch.control.policies import Policy
from ocp_torch.errors import InputError
from ocp_torch.fields.fields import Fields
from ocp_torch.maths.jets import Field
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.problem import Problem
from ocp_torch.problems.samples import Samples

POINTS = 2048  # states of an integral of one measurement
TRAJECTORIES = 256  # of a simulation with V as control variate: enough for 0.02 % on a curve
REPLICATES = 2  # of both
TOLERANCE = 2e-4  # of a simulation
ASCENTS = 8  # from the worst states, in search of a supremum: a quarter of what a certificate takes
TABLE = 2**14  # states of the table from which a policy in one dimension is simulated
# Trajectories without a control variate: from 256 of them SAC seemed .07 % better than a torus allows.
ALONE = 2048
# The keys of a `Judge` that are performances of controllers.
PERFORMANCES = ("value", "density", "policy")


@dataclass(frozen=True)
class Point:
    """``numbers`` (see `Judge`) after ``samples`` states and ``seconds`` of CPU time spent on training alone."""

    samples: int
    seconds: float
    numbers: dict[str, float]

    @property
    def perf(self) -> float:
        """The better controller's performance."""
        known = [self.numbers[n] for n in PERFORMANCES if n in self.numbers and math.isfinite(self.numbers[n])]
        return min(known, default=math.inf)

    @property
    def gap(self) -> float:
        """The gap from the highest lower to the lowest upper bound, relative to the former: infinite where one is missing, or
        the lower is not positive."""
        return self._above_the_lower(
            min((self.numbers[n] for n in bounds.on(UPPER) if n in self.numbers), default=math.inf)
        )

    @property
    def simulated(self) -> float:
        """The gap from the highest lower bound to the better controller's performance, relative to the former."""
        return self._above_the_lower(self.perf)

    def _above_the_lower(self, upper: float) -> float:
        lower = max((self.numbers[n] for n in bounds.on(LOWER) if n in self.numbers), default=-math.inf)
        return (upper - lower) / lower if lower > 0.0 else math.inf


@dataclass(frozen=True)
class Curve:
    """One run of one contender; ``certified`` is the gap of its final full certificate, `None` where that has none."""

    contender: str
    seed: int
    points: list[Point]
    certified: float | None = None
    certificate_seconds: float = 0.0
    notes: list[str] = field(default_factory=list)

    def first_within(self, tolerance: float, optimum: float) -> Point | None:
        """The first point from which on the performance stays within ``tolerance``, relative, of ``optimum``."""
        reached = None
        for point in self.points:
            within = point.perf <= optimum * (1.0 + tolerance)
            reached = (reached or point) if within else None
        return reached


def due(first: int, per_decade: int = 4) -> Iterator[int]:
    """Sample counts at which to look: ``first``, and then ``per_decade`` for each factor of ten, without end."""
    counts = (round(first * 10 ** (k / per_decade)) for k in count())
    return (each for each, _ in groupby(counts))


def median_and_spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Median, smallest and largest."""
    return statistics.median(values), min(values), max(values)


@dataclass(frozen=True, eq=False, kw_only=True)
class Measured(TrainedContext):
    """A context for cheap bounds: the same ``sets`` of states for all of them, also where few states carry a mean, no
    simulation, and no checks."""

    sets: list[Samples]
    settings: CertificateSettings = CertificateSettings(
        ascents=ASCENTS, trajectories=0, occupation_states=0, mollify=False, stage=StageSettings(steps=0)
    )
    run: Run = Run("measured", "measured")

    odd = densest = None

    @property
    def wide(self) -> list[Samples]:
        return self.sets

    few = wide

    @cached_property
    def densities(self) -> DensityBounds | None:
        return self.densities_on(self.few) if self.has_densities else None


class Judge:
    """Measures fields on states that are the same in every run, and that no training sampler draws."""

    def __init__(self, problem: Problem, constants: Constants) -> None:
        self.problem, self.constants = problem, constants
        self.sets: list[Samples] = replicated_samples(
            problem, POINTS, REPLICATES, seed=0, divergences=problem.gives_divergences
        )

    @torch.no_grad()
    def __call__(self, fields: Fields, occupation: str | None, perf: bool = True) -> dict[str, float]:
        """The values of the bounds on `OPT` that ``fields`` give, `F_M`, `shifted`, `J` and `G` among them, and with ``perf``
        the controllers' performances, `value` and `density`, by their keys in `certificate.json`. `F_M` is left out where its
        `M` is guessed or none is large enough: it would be no bound."""
        trained = Trained(fields, occupation, nn.Identity)  # nothing is fitted, so that no network is made
        context = Measured(problem=self.problem, constants=self.constants, trained=trained, sets=self.sets)
        listed = [bound for bound in BOUNDS if bound.side in (LOWER, UPPER) and bound.applies(context)]
        unproved = (PenalisedDual.name,) if self.constants.needs_no_M else ()
        found = {bound.name: bound.evaluate(context) for bound in listed if bound.name not in unproved}
        numbers = {name: estimate.value for name, estimate in found.items() if estimate is not None}
        if perf:
            initial = None if context.sampled_value is None else context.sampled_value.initial
            for name, policy in context.policies.items():
                numbers[name] = self.performance(policy, context.value, initial)
        return numbers

    def performance(self, policy: Policy, value: Field | None = None, initial: list[float] | None = None) -> float:
        """`Perf` of a policy, by simulation; beyond one dimension ``value`` is the control variate."""
        if self.problem.dim == 1:
            policy, value, initial = tabulated(policy, TABLE), None, None
        starts = ALONE if value is None else TRAJECTORIES
        simulation = Simulation(self.problem, policy, starts, REPLICATES, 0, value, initial, tolerance=TOLERANCE)
        return simulation.run().perf.value


def tabulated(policy: Policy, count: int) -> Policy:
    """``policy`` on the circle from a table at ``count`` equidistant states, periodic and linear in between."""
    table = policy(torch.arange(count, dtype=torch.float64).unsqueeze(-1) / count)

    def look_up(x: Tensor) -> Tensor:
        place = count * x.remainder(1.0)
        index = place.floor().long()[:, 0]
        part = place - place.floor()
        return torch.lerp(table[index % count], table[(index + 1) % count], part)

    return look_up


def relative(number: float, optimum: float | None) -> float:
    """``number`` relative to `OPT`, in per cent. Raises `InputError` where `OPT` is not known."""
    if optimum is None:
        raise InputError("this problem's optimum is not known, so nothing can be said relative to it.")
    return 100.0 * (number / optimum - 1.0)
