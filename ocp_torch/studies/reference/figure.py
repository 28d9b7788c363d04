"""Figures of the grid's `V` and `u` beside those of a trained controller: curves in one dimension, maps beyond."""

import torch
from torch import Tensor

from ocp_torch.control.controller import Controller
from ocp_torch.maths.supremum import batched
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.studies.reference.reference import Reference

LINE_POINTS = 400  # states along a curve
MAP_POINTS = 96  # states along each side of a map
ARROWS = 16  # arrows along each side of a map


@torch.no_grad()
def draw(reference: Reference, controller: Controller):
    """`V` and `u` of ``reference`` and ``controller``, and their differences; `V` only where the controller holds one.

    In three dimensions the cut `x_3 = 1/2`.
    """
    x = _states(reference.problem.dim)
    value, control = reference.interpolate(x)
    learned, network = controller(x).double(), controller.fields.value
    rows = {"V": {"grid": value}, "u": {"grid": control, "network": learned, "network - grid": learned - control}}
    if network is not None:
        learned = batched(network, x.to(next(network.parameters())), 8192).double()
        rows["V"] |= {"network": learned, "network - grid": learned - value}
    return (_curves if reference.problem.dim == 1 else _maps)(x, rows)


def _states(dim: int) -> Tensor:
    if dim == 1:
        return torch.linspace(0.0, 1.0, LINE_POINTS, dtype=torch.float64).unsqueeze(-1)
    line = (torch.arange(MAP_POINTS, dtype=torch.float64) + 0.5) / MAP_POINTS
    x = torch.full((MAP_POINTS**2, dim), 0.5, dtype=torch.float64)
    x[:, :2] = torch.cartesian_prod(line, line)
    return x


def _curves(x: Tensor, rows: dict[str, dict[str, Tensor]]):
    """Grid and network on one axis, their difference on another."""
    figure = blank_figure(9.6, 7.6)
    for line, (symbol, drawn) in zip(figure.subplots(2, 2), rows.items(), strict=True):
        for name, values in drawn.items():
            axis = line[1 if name == "network - grid" else 0]
            axis.plot(x, values.reshape(len(x), -1), "k:" if name == "grid" else "-", label=name)
            axis.set(title=symbol, xlabel="x")
            axis.legend()
        line[1].set_visible("network - grid" in drawn)
    return figure


def _maps(x: Tensor, rows: dict[str, dict[str, Tensor]]):
    """A map for each; a control of several components as its size, with arrows for its first two."""
    figure = blank_figure(14.4, 7.6)
    line = (torch.arange(MAP_POINTS) + 0.5) / MAP_POINTS
    for row, (symbol, drawn) in zip(figure.subplots(2, 3), rows.items(), strict=True):
        sizes = {name: v.reshape(len(x), -1) for name, v in drawn.items()}
        sizes = {name: v.norm(dim=-1) if v.shape[1] > 1 else v[:, 0] for name, v in sizes.items()}
        shared = torch.cat([s for name, s in sizes.items() if name != "network - grid"])
        for axis in row[len(drawn) :]:
            axis.set_visible(False)
        for axis, (name, size) in zip(row, sizes.items(), strict=False):
            limits = {} if name == "network - grid" else {"vmin": float(shared.min()), "vmax": float(shared.max())}
            image = axis.imshow(size.reshape(MAP_POINTS, -1).T, origin="lower", extent=(0, 1, 0, 1), **limits)
            values = drawn[name]
            several = values.ndim == 2 and values.shape[1] > 1
            if several:
                stride = MAP_POINTS // ARROWS
                arrows = values[:, :2].reshape(MAP_POINTS, MAP_POINTS, 2)[::stride, ::stride]
                axis.quiver(line[::stride], line[::stride], arrows[..., 0].T, arrows[..., 1].T, color="w")
            axis.set(title=f"|{symbol}|, {name}" if several else f"{symbol}, {name}", xlabel="$x_1$", ylabel="$x_2$")
            figure.colorbar(image, ax=axis)
    return figure
