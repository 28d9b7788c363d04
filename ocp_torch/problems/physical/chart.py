"""The map between physical states and states of the torus, and the cut-off that closes an interval to a circle."""

import torch
from torch import Tensor

from ocp_torch.errors import InputError
from ocp_torch.maths.sampling import scrambled_sobol
from ocp_torch.problems.device_constants import DeviceConstants
from ocp_torch.problems.physical.coordinates import Coordinate, Interval

# Coordinates of a state that a sentence shows.
MOST_SHOWN = 8
# Rounding may carry a state beyond a seam by this part of a turn, or beyond the box by this part of its half-width.
ROUNDING = 1e-6
# Number of the fixed design of states spread over a box.
DESIGN = 31
# Corners of a box are added to these states where there are no more than this.
MOST_CORNERS = 2**12


def smooth_step(z: Tensor) -> Tensor:
    """A twice differentiable step from 1 at `z <= 0` to 0 at `z >= 1`: `t^3 (10 - 15 t + 6 t^2)` with `t = 1 - z`, a form in
    which rounding makes no density negative."""
    t = 1.0 - z.clamp(0.0, 1.0)
    return (t**3 * (10.0 - 15.0 * t + 6.0 * t**2)).clamp_max(1.0)


class Chart(DeviceConstants):
    """The map `x_i = (s_i - centre_i) / length_i` mod 1 of ``coordinates``; an interval's seam is at `x_i = 1/2`. Physical
    states begin at ``start``, in turns from the centre."""

    def __init__(self, coordinates: tuple[Coordinate, ...]) -> None:
        self.coordinates = coordinates
        column = lambda name: torch.tensor([getattr(c, name) or 0.0 for c in coordinates], dtype=torch.float64)
        self.centre, self.length = column("centre"), column("length")
        halves = [isinstance(c, Interval) or c.low is None for c in coordinates]
        self.start = torch.where(torch.tensor(halves), -0.5, column("low") / self.length)
        boxed = [(i, c) for i, c in enumerate(coordinates) if isinstance(c, Interval)]
        self.boxed = [i for i, _ in boxed]
        self.volume = float(self.length.prod())
        self._rows = torch.tensor(self.boxed, dtype=torch.long)
        self._half = torch.tensor([0.5 * (c.high - c.low) for _, c in boxed], dtype=torch.float64)
        self._seam = torch.tensor([c.seam for _, c in boxed], dtype=torch.float64)

    def from_torus(self, x: Tensor) -> Tensor:
        """States ``(N, d)`` in physical units: angles from their low end on, intervals up to their seams."""
        start = self._like(x, "start", self.start)
        turns = (x - start).remainder(1.0) + start
        return self._like(x, "centre", self.centre) + turns * self.lengths(x)

    def to_torus(self, s: Tensor) -> Tensor:
        """States ``(N, d)`` in physical units as states of the torus in [0, 1); raises `InputError` beyond a seam."""
        turns = self.turns(s)
        beyond = turns[:, self.boxed].abs() > 0.5 + ROUNDING
        if bool(beyond.any()):
            row, which = beyond.nonzero()[0].tolist()
            c = self.coordinates[self.boxed[which]]
            raise InputError(
                f"{c.name} is {float(s[row, self.boxed[which]]):g} {c.unit}".rstrip()
                + f", beyond the seam of the model at {c.centre - 0.5 * c.length:g} and {c.centre + 0.5 * c.length:g}."
            )
        return turns.remainder(1.0)

    def clipped(self, s: Tensor) -> Tensor:
        """`to_torus`, with coordinates beyond a seam moved to it."""
        turns = self.turns(s)
        turns[:, self.boxed] = turns[:, self.boxed].clamp(-0.5, 0.5)
        return turns.remainder(1.0)

    def turns(self, s: Tensor) -> Tensor:
        """How far states ``(N, d)`` are from the centres, in turns of each coordinate."""
        return (s - self._like(s, "centre", self.centre)) / self.lengths(s)

    def lengths(self, like: Tensor) -> Tensor:
        """The length of a turn of each coordinate in its unit, ``(d,)``."""
        return self._like(like, "length", self.length)

    def wrapped(self, offset: Tensor) -> Tensor:
        """The shortest of the ``offset``s ``(.., d)`` of two states on the torus, in physical units."""
        length = self.lengths(offset)
        return (offset + 0.5 * length).remainder(length) - 0.5 * length

    def cut(self, s: Tensor) -> Tensor:
        """The cut-off `chi` ``(N,)``: 1 in the box, 0 at the seams."""
        chi = torch.ones_like(s[:, 0])
        for step in smooth_step(self._beyond(s)).unbind(-1) if self.boxed else ():
            chi = chi * step
        return chi

    def cut_with_slope(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """`chi` ``(N,)`` and its gradient in the units of `s`, ``(N, d)``."""
        slope = torch.zeros_like(s)
        if not self.boxed:
            return torch.ones_like(s[:, 0]), slope
        z = self._beyond(s)
        steps = smooth_step(z)
        side = self._from_centre(s).sign() / self._like(s, "seam", self._seam)
        for k, i in enumerate(self.boxed):
            rest = torch.cat([steps[:, :k], steps[:, k + 1 :]], dim=-1).prod(dim=-1)
            slope[:, i] = -30.0 * (z[:, k] * (1.0 - z[:, k])).square() * side[:, k] * rest
        return steps.prod(dim=-1), slope

    def _beyond(self, s: Tensor) -> Tensor:
        """How far along each interval's coordinate is from its end (0) to the seam (1), ``(N, K)``."""
        off = self._from_centre(s).abs()
        return ((off - self._like(s, "half", self._half)) / self._like(s, "seam", self._seam)).clamp(0.0, 1.0)

    def _from_centre(self, s: Tensor) -> Tensor:
        """How far each interval's coordinate is from the middle, ``(N, K)``."""
        return (s - self._like(s, "centre", self.centre)).index_select(1, self._like(s, "rows", self._rows))

    def outside(self, s: Tensor) -> Tensor:
        """Whether states ``(N, d)`` are beyond the end of an interval, ``(N,)``."""
        off = self._from_centre(s).abs()
        return (off > self._like(s, "half", self._half) * (1.0 + ROUNDING)).any(dim=-1)

    def nearest(self, s: Tensor) -> Tensor:
        """The states of the box nearest to ``s`` ``(N, d)``, coordinate by coordinate."""
        low = [c.low if isinstance(c, Interval) else -torch.inf for c in self.coordinates]
        high = [c.high if isinstance(c, Interval) else torch.inf for c in self.coordinates]
        return s.clamp(s.new_tensor(low), s.new_tensor(high))

    def spread(self, count: int) -> Tensor:
        """``count`` states spread over the box, and its corners where these are few, with angles at 0 and half a period."""
        ends = [(c.low, c.high) if isinstance(c, Interval) else (0.0, 0.5 * c.length) for c in self.coordinates]
        low, high = (torch.tensor(side, dtype=torch.float64) for side in zip(*ends, strict=True))
        turns = torch.tensor([1.0 if isinstance(c, Interval) else 2.0 for c in self.coordinates], dtype=torch.float64)
        s = low + (high - low) * turns * scrambled_sobol(count, len(ends), DESIGN, torch.float64)
        if 2 ** len(ends) > MOST_CORNERS:
            return s
        corners = torch.cartesian_prod(*(torch.tensor(pair, dtype=torch.float64) for pair in ends))
        return torch.cat([s, corners.reshape(-1, len(ends))])

    def place(self, s: Tensor) -> str:
        """One state ``(d,)`` for a sentence, as in ``pole = 0.3 rad, velocity = 2 m/s``."""
        pairs = list(zip(self.coordinates, s.tolist(), strict=True))[:MOST_SHOWN]
        text = ", ".join(f"{c.name} = {value:.6g} {c.unit}".rstrip() for c, value in pairs)
        return text + (", .." if len(s) > MOST_SHOWN else "")
