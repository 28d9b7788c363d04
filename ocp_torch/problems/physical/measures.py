"""Names and units of states and controls, in a form that a file can hold."""

from dataclasses import asdict, dataclass

from ocp_torch.errors import InputError, require_number
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
    """The ``coordinates``, the ``controls``, and in ``scales`` one unit of each control as a control of the torus problem."""

    coordinates: tuple[Coordinate, ...]
    controls: tuple[Control, ...]
    scales: tuple[float, ...]

    @property
    def plain(self) -> dict:
        """All measures as data for JSON."""
        given = [{k: v for k, v in asdict(c).items() if v is not None} for c in self.coordinates]
        controls = [{**asdict(c), "scale": scale} for c, scale in zip(self.controls, self.scales, strict=True)]
        return {"coordinates": given, "controls": controls}

    @property
    def text(self) -> str:
        """All measures as a line of text."""
        coordinates, controls = (", ".join(c.label for c in group) for group in (self.coordinates, self.controls))
        return f"coordinates: {coordinates}; controls: {controls}"

    @classmethod
    def of(cls, plain: dict, dim: int, control_dim: int) -> "Measures":
        """The measures that ``plain``, from an untrusted file, describes. Raises `ValueError`, `KeyError`, `TypeError` or
        `AttributeError` unless it describes ``dim`` coordinates and ``control_dim`` controls."""
        rows, others = plain["coordinates"], plain["controls"]
        if (len(rows), len(others)) != (dim, control_dim):
            raise InputError(f"it names {len(rows)} coordinates and {len(others)} controls of {dim} and {control_dim}")
        # The constructors refuse whatever else is wrong.
        coordinates = require_coordinates([(Interval if "high" in row else Angle)(**row) for row in rows])
        controls = require_controls([Control(row["name"], row.get("unit", "")) for row in others])
        return cls(
            coordinates, controls, tuple(require_number("scale", r.get("scale", 1.0), above=0.0) for r in others)
        )
