"""Where a system starts: densities in physical units, of mass 1 and none of it outside the box."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ocp_torch.errors import InputError, nearest, require_numbers, shown
from ocp_torch.maths.mixture_fit import FITTED_PART, fitted_mixture
from ocp_torch.maths.mixtures import WIDEST, Mixture
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.problems.device_constants import DeviceConstants
from ocp_torch.problems.physical.chart import Chart, smooth_step
from ocp_torch.problems.physical.coordinates import Interval

# Part of a range over which a density rises at either end of it: a jump would have no divergence.
EDGE = 0.1
# The integral of the kernel (1 - z^2)^3 from -1 to 1.
KERNEL_MASS = 32.0 / 35.0
STATES = 2**13  # for each estimate of a density's mass
REPLICATES = 8  # independent estimates
QUANTILE = 5.4079  # Student's t of their mean, two-sided level 0.999, 7 degrees of freedom
UNCERTAIN = 5e-3  # part of the mass that may be uncertain
OUTSIDE = 1e-3  # mass outside the box that is allowed, as a part of that inside
# Starts in a range are drawn normally with a deviation of this part of its half: four of five then weigh about the same.
DEVIATION = 0.6
# Starts in a range that fills more than this part of a turn are drawn evenly.
EVEN_FROM = 0.75


@dataclass(frozen=True)
class Points:
    """Starts near ``states``, a list of physical ones: density `(1 - z^2)^3` in each coordinate up to a distance
    of ``spread``, one number for each coordinate; the standard deviation is a third of it."""

    states: Sequence[Sequence[float]]
    spread: Sequence[float]


class Density(Protocol):
    def __call__(self, s: Tensor, /) -> Tensor:
        """Density ``(N,)`` at physical states ``(N, d)``, per unit of each coordinate."""


Start = Mapping[str, Sequence[float]] | Points | Callable[[Tensor], Tensor] | None


def start_density(chart: Chart, start: object) -> Density:
    """The density that ``start`` describes; raises `InputError` where it describes none, or has mass outside the box.

    `None` is the whole box and a mapping of names to (low, high) a part of it, both uniform but for smooth edges inside the
    ranges. `Points` are bumps; a function of physical states is the density up to a factor.
    """
    if start is None or isinstance(start, Mapping):
        return _Ranges(chart, start or {})
    if isinstance(start, Points):
        return _Bumps(chart, start)
    if callable(start):
        return _Scaled(chart, start)
    raise InputError(
        f"start is {shown(start)}, but must be ranges, as in {{'{chart.coordinates[0].name}': (low, high)}}, Points(..) or a "
        "function of physical states."
    )


class _Ranges(DeviceConstants):
    def __init__(self, chart: Chart, ranges: Mapping) -> None:
        names = [c.name for c in chart.coordinates]
        for name in ranges:
            if name not in names:
                raise InputError(
                    f"start names {shown(name)}, but must name coordinates: {', '.join(names)}{nearest(str(name), names)}."
                )
        rows, self.whole = [], 1.0
        for i, c in enumerate(chart.coordinates):
            if c.name in ranges:
                rows.append((i, *_require_range(c, ranges[c.name])))
            elif isinstance(c, Interval):
                rows.append((i, c.low, c.high))
            else:
                self.whole /= c.length
        self.chart, self.columns = chart, [row[0] for row in rows]
        low, high = (torch.tensor([row[k] for row in rows], dtype=torch.float64) for k in (1, 2))
        self.middle = torch.zeros(len(chart.coordinates), dtype=torch.float64)
        self.middle[self.columns] = 0.5 * (low + high)
        self.half = 0.5 * (high - low)
        self._columns = torch.tensor(self.columns, dtype=torch.long)

    def __call__(self, s: Tensor) -> Tensor:
        half = self._like(s, "half", self.half)
        off = self.chart.wrapped(s - self._like(s, "middle", self.middle))
        off = off.index_select(1, self._like(s, "columns", self._columns)).abs()
        edge = 2.0 * EDGE * half
        factors = smooth_step((off - (half - edge)) / edge) / (2.0 * half - edge)
        return self.whole * factors.prod(dim=-1)

    @property
    def mixture(self) -> Mixture:
        """A normal density over the ranges, flat along coordinates that fill most of a turn."""
        length = self.chart.length[self.columns]
        widths = torch.full_like(self.middle, WIDEST)
        widths[self.columns] = torch.where(2.0 * self.half > EVEN_FROM * length, WIDEST, DEVIATION * self.half / length)
        return _normal(self.chart, self.middle.unsqueeze(0), widths)


class _Bumps(DeviceConstants):
    def __init__(self, chart: Chart, points: Points) -> None:
        coordinates, states = chart.coordinates, points.states
        spread = require_numbers("the spread of Points", _listed(points.spread), len(coordinates), above=0.0)
        if not isinstance(_listed(states), Sequence) or not len(states):
            raise InputError(f"the states of Points are {shown(states)}, but must be a list of physical states.")
        rows = [require_numbers(f"state {k} of Points", _listed(r), len(coordinates)) for k, r in enumerate(states)]
        for row in rows:
            for c, value, width in zip(coordinates, row, spread, strict=True):
                _require_range(c, (value - width, value + width))
        self.chart, self.spread = chart, torch.tensor(spread, dtype=torch.float64)
        self.states = torch.tensor(rows, dtype=torch.float64)

    def __call__(self, s: Tensor) -> Tensor:
        spread = self._like(s, "spread", self.spread)
        z = self.chart.wrapped(s[:, None] - self._like(s, "states", self.states)) / spread
        kernel = (1.0 - z.square()).clamp_min(0.0) ** 3 / (KERNEL_MASS * spread)
        return kernel.prod(dim=-1).mean(dim=-1)

    @property
    def mixture(self) -> Mixture:
        """Normal densities a little wider than the kernels, whose standard deviation is a third of the spread."""
        return _normal(self.chart, self.states, (0.4 * self.spread / self.chart.length).clamp_max(WIDEST))


class _Scaled:
    """A user's function, normalised to mass 1 and brought to 0 at the ends of the box by the edges of `_Ranges`."""

    def __init__(self, chart: Chart, function: Callable[[Tensor], Tensor]) -> None:
        self.chart, self.function, self.total = chart, function, 1.0
        self.window, self.level = _Ranges(chart, {}), 1.0
        middle = torch.tensor([[c.centre for c in chart.coordinates]], dtype=torch.float64)
        self.level = float(self.window(middle))
        beyond = lambda s: torch.where(chart.outside(s), function(s), 0.0)
        (inside, half), (lost, _) = (_mass(chart, f) for f in (self, beyond))
        if not inside > 0.0:
            wrong = "below 0" if inside < 0.0 else "not finite"
            found = "0 at all states of the box that were tried" if inside == 0.0 else wrong
            raise InputError(f"the density given as start is {found}, but must be at least 0, and above 0 somewhere.")
        if lost > OUTSIDE * inside:
            part = lost / (lost + inside)
            raise InputError(f"{100.0 * part:.2g} % of start is outside the box, but must be inside it.")
        if half > UNCERTAIN * inside:
            off = 100.0 * half / inside
            raise InputError(
                f"the mass of the density given as start is uncertain by {off:.2g} %, as it is narrow or has jumps; ranges "
                "or Points are normalised exactly."
            )
        self.total = inside

    def __call__(self, s: Tensor) -> Tensor:
        return self.function(s) * (self.window(s) / (self.level * self.total))


def _normal(chart: Chart, centres: Tensor, widths: Tensor) -> Mixture:
    if bool((widths == WIDEST).all()):
        return Mixture.uniform(len(widths))
    count = len(centres)
    return Mixture(
        torch.full((count,), FITTED_PART / count).double(), chart.to_torus(centres), widths.expand(count, -1)
    )


def _mass(chart: Chart, density: Density) -> tuple[float, float]:
    """The integral of ``density`` over the torus and the half-width of its interval, from states drawn where it is large."""
    found = lambda x: chart.volume * density(chart.from_torus(x))
    fit = fitted_mixture(found, len(chart.coordinates))
    draws = (fit.draw(STATES, r, derive_seed(0, Branch.START_MASS, r)) for r in range(REPLICATES))
    means = torch.stack([(weight * found(x)).mean() for x, weight in draws])
    return float(means.mean()), QUANTILE * float(means.std()) / REPLICATES**0.5


def _listed(value: object) -> object:
    return value.tolist() if isinstance(value, Tensor) else value


def _require_range(c, given: object) -> tuple[float, float]:
    """``given`` as a range of the coordinate ``c``, in its unit."""
    low, high = require_numbers(f"start[{c.name!r}]", _listed(given), 2)
    text = f"start has {c.name} from {low:g} to {high:g} {c.unit}".rstrip()
    if low >= high:
        raise InputError(f"{text}, but low must be below high{' (swapped?)' if low > high else ''}.")
    rounding = 1e-9 * c.length
    if isinstance(c, Interval) and not (c.low - rounding <= low and high <= c.high + rounding):
        raise InputError(f"{text}, which is not inside the box, from {c.low:g} to {c.high:g}.")
    if not isinstance(c, Interval) and high - low > c.length + rounding:
        raise InputError(f"{text}, which is more than its period of {c.length:g}; leave {c.name} out for all of it.")
    return low, high
