"""What states and controls of a problem are called and measured in, in words that a file can hold."""

from dataclasses import asdict, dataclass

from ocp_torch.errors import InputError, require_number, shown
from ocp_torch.problems.physical.coordinates import (
    Angle,
    Control,
    Coordinate,
    Interval,
    require_controls,
    require_coordinates,
)


@dataclass(frozen=True)
class Measures:
    """The ``coordinates``, the ``controls``, and as ``scales`` what one unit of each is as a control of the torus problem."""

    coordinates: tuple[Coordinate, ...]
    controls: tuple[Control, ...]
    scales: tuple[float, ...]

    @property
    def plain(self) -> dict:
        """As JSON can hold them."""
        given = [{k: v for k, v in asdict(c).items() if v is not None} for c in self.coordinates]
        controls = [{**asdict(c), "scale": scale} for c, scale in zip(self.controls, self.scales, strict=True)]
        return {"coordinates": given, "controls": controls}

    @property
    def text(self) -> str:
        """As a line to be read."""
        coordinates, controls = (", ".join(c.label for c in group) for group in (self.coordinates, self.controls))
        return f"coordinates: {coordinates}; controls: {controls}"

    @classmethod
    def of(cls, plain: dict, dim: int, control_dim: int) -> "Measures":
        """Those that ``plain``, of a stranger's file, describes; `InputError` unless it does so for ``dim`` coordinates and
        ``control_dim`` controls."""
        rows, others = (_rows(plain, *size) for size in (("coordinates", dim), ("controls", control_dim)))
        coordinates = require_coordinates([_coordinate(row) for row in rows])
        controls = require_controls([Control(row.get("name"), row.get("unit", "")) for row in others])  # type: ignore[arg-type]
        scales = tuple(require_number("scale", row.get("scale", 1.0), above=0.0) for row in others)
        return cls(coordinates, controls, scales)


def _rows(plain: dict, name: str, count: int) -> list[dict]:
    rows = plain.get(name)
    if not isinstance(rows, list) or len(rows) != count or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{name} are {shown(rows)}, but must be a list of {count} with a name and a unit each")
    return rows


def _coordinate(row: dict) -> Coordinate:
    """Its constructor refuses whatever is wrong."""
    kind, names = (Interval, ("low", "high", "margin")) if "high" in row else (Angle, ("period", "low"))
    given = {name: row[name] for name in ("unit", *names) if name in row}
    if kind is Interval:
        given["low"] = row.get("low")
    return kind(row.get("name"), **given)  # type: ignore[arg-type]
