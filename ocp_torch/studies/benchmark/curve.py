"""What a contender reached, and when: points along one run, and several runs together."""

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field

from ocp_torch.certificate import LOWER, UPPER, bounds

# The keys of `measure.Judge` that are performances of controllers.
PERFORMANCES = ("value", "density", "policy")


@dataclass(frozen=True)
class Point:
    """``numbers`` (see `measure.Judge`) after ``samples`` states and ``seconds`` of CPU time spent on training alone."""

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
        """From the highest lower bound to the lowest upper one, relative to the former: infinite where one is missing, or the
        lower is not positive."""
        upper = min((self.numbers[n] for n in bounds.on(UPPER) if n in self.numbers), default=math.inf)
        lower = max((self.numbers[n] for n in bounds.on(LOWER) if n in self.numbers), default=-math.inf)
        return (upper - lower) / lower if lower > 0.0 else math.inf


@dataclass(frozen=True)
class Curve:
    """One run of one contender; ``certified`` is the gap of the full certificate of its end, `None` where it has none."""

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


def due(first: int, per_decade: int = 4):
    """Sample counts at which to look: ``first``, and then ``per_decade`` for each factor of ten, without end."""
    k, last = 0, 0
    while True:
        count = round(first * 10 ** (k / per_decade))
        k += 1
        if count > last:
            last = count
            yield count


def median_and_spread(values: Sequence[float]) -> tuple[float, float, float]:
    """Median, smallest and largest."""
    return statistics.median(values), min(values), max(values)
