"""Frames of figures of functions on the torus: states to draw at, and axes in turns or in a system's own units."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ocp_torch.problems import Problem
from ocp_torch.problems.physical.chart import Chart

Function = Callable[[Tensor], Any]


@dataclass(frozen=True)
class Frame:
    """The unit cell from ``start`` on in each coordinate, cut through the middle of coordinates that are not drawn.
    Coordinates have ``labels``, formulas where they are ``symbols``; their values on the axes are `centre + length x`."""

    labels: tuple[str, ...]
    centre: Tensor
    length: Tensor
    start: Tensor
    symbols: bool = True
    control: str = ""  # name and unit of a single control

    def line(self, count: int) -> Tensor:
        """States ``(count, 1)`` along the only coordinate."""
        return self.start + torch.linspace(0.0, 1.0, count, dtype=torch.float64).unsqueeze(-1)

    def map(self, count: int) -> Tensor:
        """States ``(count^2, d)`` over the first two coordinates."""
        middles = (torch.arange(count, dtype=torch.float64) + 0.5) / count
        x = (self.start + 0.5).repeat(count**2, 1)
        x[:, :2] = self.start[:2] + torch.cartesian_prod(middles, middles)
        return x

    def places(self, x: Tensor) -> Tensor:
        """States ``(N, d)`` of `line` or `map` in the units of the axes."""
        return self.centre + self.length * x

    @property
    def ends(self) -> Tensor:
        """The beginning and end of each axis, ``(d, 2)``."""
        return torch.stack([self.places(at) for at in (self.start, self.start + 1.0)], dim=-1)

    @property
    def extent(self) -> tuple[float, ...]:
        """Left, right, bottom and top of a map."""
        return tuple(self.ends[:2].flatten().tolist())

    @property
    def aspect(self) -> str:
        """Equal where a turn of either coordinate is as long as one of the other."""
        return "equal" if len(set(self.length[:2].tolist())) == 1 else "auto"


def frame_of(problem: Problem) -> Frame:
    """The frame of ``problem``; in physical units it begins where the coordinates do, and has their names and units."""
    if (measures := problem.measures) is not None:
        labels, chart = tuple(c.label for c in measures.coordinates), Chart(measures.coordinates)
        control = measures.controls[0].label if problem.control_dim == 1 else ""
        return Frame(labels, chart.centre, chart.length, chart.start, symbols=False, control=control)
    labels = ("x",) if problem.dim == 1 else tuple(f"$x_{i + 1}$" for i in range(problem.dim))
    one = torch.ones(problem.dim, dtype=torch.float64)
    return Frame(labels, 0.0 * one, one, 0.0 * one)


def in_units(problem: Problem, control: Function) -> Function:
    """A single ``control`` on the torus in its unit, where it has one. Several controls ``(N, m)`` are left as they are: a
    figure shows their size, whose square is twice the price."""
    measures = problem.measures
    if measures is None or problem.control_dim > 1:
        return control
    return lambda x: None if (v := control(x)) is None else v / measures.scales[0]
