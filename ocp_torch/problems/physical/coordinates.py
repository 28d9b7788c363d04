"""What states and controls are called, the units they are in, and the ranges of the coordinates."""

import re
from dataclasses import dataclass

from ocp_torch.errors import InputError, require_number, shown
from ocp_torch.problems.physical.units import TURNS, labelled, require_unit

# Part of an interval that is added on each side of it, where the model is slowed down to a stop.
MARGIN = 0.125


@dataclass(frozen=True)
class Angle:
    """A coordinate of period ``period``, by default a full turn in its ``unit``: an angle, a phase, a place on a ring.

    Its values are in `[low, low + period)`, by default within half a period of 0, which is at 0 on the torus. Raises
    `InputError` for an unknown unit, or a period it has no sense with.
    """

    name: str
    period: float | None = None
    unit: str = "rad"
    low: float | None = None

    def __post_init__(self) -> None:
        _require_name("coordinate", self.name)
        require_unit(f"the unit of {self.name}", self.unit)
        if self.period is None and self.unit not in TURNS:
            raise InputError(f"the period of {self.name} is missing; give it, in {self.unit or 'its unit'}.")
        period = TURNS[self.unit] if self.period is None else self.period
        object.__setattr__(self, "period", require_number(f"the period of {self.name}", period, above=0.0))
        if self.low is not None:
            object.__setattr__(self, "low", require_number(f"the low end of {self.name}", self.low))

    @property
    def label(self) -> str:
        return labelled(self.name, self.unit)

    @property
    def centre(self) -> float:
        return 0.0

    @property
    def length(self) -> float:
        """The period: what a turn of the torus coordinate is, in ``unit``."""
        assert self.period is not None
        return self.period


@dataclass(frozen=True)
class Interval:
    """A coordinate in `[low, high]`: the model is exact there, and comes to a stop over ``margin * (high - low)`` beyond
    either end. Raises `InputError` for an unknown unit, limits that are swapped or not finite, and a margin not above 0."""

    name: str
    low: float
    high: float
    unit: str = ""
    margin: float = MARGIN

    def __post_init__(self) -> None:
        _require_name("coordinate", self.name)
        require_unit(f"the unit of {self.name}", self.unit)
        for end in ("low", "high"):
            object.__setattr__(self, end, require_number(f"the {end} end of {self.name}", getattr(self, end)))
        if self.low >= self.high:
            hint = " (swapped?)" if self.low > self.high else ""
            raise InputError(f"{self.name} goes from {self.low:g} to {self.high:g}, but low must be below high{hint}.")
        margin = require_number(f"the margin of {self.name}", self.margin, at_least=1e-6, at_most=1e3)
        object.__setattr__(self, "margin", margin)

    @property
    def label(self) -> str:
        return labelled(self.name, self.unit)

    @property
    def centre(self) -> float:
        return 0.5 * (self.low + self.high)

    @property
    def seam(self) -> float:
        """How wide the margin is, in ``unit``."""
        return self.margin * (self.high - self.low)

    @property
    def length(self) -> float:
        """Interval and margins: what a turn of the torus coordinate is, in ``unit``."""
        return (self.high - self.low) + 2.0 * self.seam


Coordinate = Angle | Interval


@dataclass(frozen=True)
class Control:
    """A control by ``name`` and ``unit``; raises `InputError` for an unknown unit."""

    name: str
    unit: str = ""

    def __post_init__(self) -> None:
        _require_name("control", self.name)
        require_unit(f"the unit of {self.name}", self.unit)

    @property
    def label(self) -> str:
        return labelled(self.name, self.unit)

    @classmethod
    def of(cls, given: object) -> "Control":
        """A control as it is given: itself, or as in ``"force [N]"``."""
        if isinstance(given, Control):
            return given
        found = re.fullmatch(r"\s*([^\[\]]*?)\s*(?:\[([^\[\]]*)\])?\s*", given) if isinstance(given, str) else None
        if found is None:
            raise InputError(f"the control {shown(given)} must be a name, with a unit where it has one: 'force [N]'.")
        return cls(found[1], found[2] or "")


def require_coordinates(given: object) -> tuple[Coordinate, ...]:
    """``given`` if it is a list of coordinates of different names; `InputError` if not."""
    if isinstance(given, Angle | Interval):
        given = [given]
    if not isinstance(given, list | tuple) or not given or not all(isinstance(c, Angle | Interval) for c in given):
        raise InputError(f"coordinates are {shown(given)}, but must be a list of Angle(..) and Interval(..).")
    _require_distinct("coordinates", [c.name for c in given])
    return tuple(given)


def require_controls(given: object) -> tuple[Control, ...]:
    """``given`` as controls of different names; `InputError` if it is none."""
    if isinstance(given, str | Control):
        given = [given]
    if not isinstance(given, list | tuple) or not given:
        raise InputError(f"controls are {shown(given)}, but must be a list of names, as in ['force [N]'].")
    controls = tuple(Control.of(one) for one in given)
    _require_distinct("controls", [c.name for c in controls])
    return controls


def _require_name(kind: str, name: object) -> None:
    if (
        not isinstance(name, str)
        or not name.strip()
        or not name.isprintable()
        or len(name) > 40
        or name != name.strip()
    ):
        raise InputError(f"the name of a {kind} is {shown(name)}, but must be a word or two.")


def _require_distinct(kind: str, names: list[str]) -> None:
    twice = next((name for i, name in enumerate(names) if name in names[:i]), None)
    if twice is not None:
        raise InputError(f"two {kind} are called {twice!r}, but each must have a name of its own.")
