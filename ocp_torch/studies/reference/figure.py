"""The grid's `V` and `u` beside those of a trained controller: curves in one dimension, maps beyond."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ocp_torch.control.controller import Controller
from ocp_torch.files.storage import write_atomically
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.studies.reference.reference import Reference

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# States along a curve, along each side of a map, and arrows along each side of it.
LINE_POINTS, MAP_POINTS, ARROWS = 400, 96, 16


def draw(reference: Reference, controller: Controller | None = None) -> Figure:
    """`V` and `u` of ``reference``; with a ``controller`` also its own, and their differences where it holds a `V`.

    In three dimensions the cut `x_3 = 1/2`.
    """
    x = _states(reference.problem.dim)
    value, control = reference.interpolate(x)
    rows = {"V": {"grid": value}, "u": {"grid": control}}
    if controller is not None:
        with torch.no_grad():
            learned = controller(x).double()
            rows["u"] |= {"network": learned, "network - grid": learned - control}
            network = controller.fields.value
            if network is not None:
                learned = torch.cat([network(part) for part in x.to(controller._like).split(8192)]).double()
                rows["V"] |= {"network": learned, "network - grid": learned - value}
    return (_curves if reference.problem.dim == 1 else _maps)(x, rows)


def save_figure(path: Path, figure: Figure) -> None:
    """Write ``figure`` as a PNG, whole or not at all."""
    write_atomically(path, lambda temporary: figure.savefig(temporary, dpi=120, format="png"))


def _states(dim: int) -> Tensor:
    if dim == 1:
        return torch.linspace(0.0, 1.0, LINE_POINTS, dtype=torch.float64).unsqueeze(-1)
    line = (torch.arange(MAP_POINTS, dtype=torch.float64) + 0.5) / MAP_POINTS
    x = torch.full((MAP_POINTS**2, dim), 0.5, dtype=torch.float64)
    x[:, :2] = torch.cartesian_prod(line, line)
    return x


def _panels(rows: int, columns: int):
    figure = blank_figure(4.8 * columns, 3.8 * rows)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _curves(x: Tensor, rows: dict[str, dict[str, Tensor]]) -> Figure:
    """Grid and network on one axis, their difference on another."""
    columns = 1 + any("network - grid" in drawn for drawn in rows.values())
    figure, axes = _panels(len(rows), columns)
    for line, (symbol, drawn) in zip(axes, rows.items(), strict=True):
        for axis in line:
            axis.set(title=symbol, xlabel="x")
        for name, values in drawn.items():
            axis = line[-1 if name == "network - grid" else 0]
            axis.plot(x, values.reshape(len(x), -1), "k:" if name == "grid" else "-", label=name)
            axis.legend()
        if columns > 1 and "network - grid" not in drawn:
            line[1].set_visible(False)
    return figure


def _maps(x: Tensor, rows: dict[str, dict[str, Tensor]]) -> Figure:
    """A map for each; a control of several components as its size, with arrows for its first two."""
    figure, axes = _panels(len(rows), max(len(drawn) for drawn in rows.values()))
    line = (torch.arange(MAP_POINTS) + 0.5) / MAP_POINTS
    for row, (symbol, drawn) in zip(axes, rows.items(), strict=True):
        sizes = {name: v.reshape(len(x), -1) for name, v in drawn.items()}
        sizes = {name: v.norm(dim=-1) if v.shape[1] > 1 else v[:, 0] for name, v in sizes.items()}
        shared = torch.cat([s for name, s in sizes.items() if name != "network - grid"])
        for axis in row[len(drawn) :]:
            axis.set_visible(False)
        for axis, (name, size) in zip(row, sizes.items(), strict=False):
            limits = {} if name == "network - grid" else {"vmin": float(shared.min()), "vmax": float(shared.max())}
            image = axis.imshow(size.reshape(MAP_POINTS, -1).T, origin="lower", extent=(0, 1, 0, 1), **limits)
            values = drawn[name]
            if values.ndim == 2 and values.shape[1] > 1:
                stride = MAP_POINTS // ARROWS
                arrows = values[:, :2].reshape(MAP_POINTS, MAP_POINTS, 2)[::stride, ::stride]
                axis.quiver(line[::stride], line[::stride], arrows[..., 0].T, arrows[..., 1].T, color="w")
                axis.set_title(f"|{symbol}|, {name}")
            else:
                axis.set_title(f"{symbol}, {name}")
            axis.set(xlabel="$x_1$", ylabel="$x_2$")
            figure.colorbar(image, ax=axis)
    return figure
