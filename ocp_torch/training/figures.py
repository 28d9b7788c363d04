"""Figures of `V`, `u`, `mu` and the HJB slack: curves in one dimension, maps over two coordinates beyond."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from ocp_torch.bounds import Bounds
from ocp_torch.certificate.certify import in_float64
from ocp_torch.certificate.sides import slack_function
from ocp_torch.control_laws import control_laws, occupation_density
from ocp_torch.extremum import batched
from ocp_torch.fields import Fields
from ocp_torch.problems import Problem

LINE_POINTS, MAP_POINTS = 400, 80
TITLES = {
    "value": "V",
    "control_value": "u from V",
    "control_density": "u = w / mu",
    "occupation": "mu",
    "slack": "HJB slack Q",
}


def quantities(problem: Problem, fields: Fields, bounds: Bounds, occupation: str | None) -> dict[str, tuple]:
    """Name -> (learned function, exact function or None), for what the fields give."""
    fields = in_float64(fields)
    laws = control_laws(occupation, problem, fields, bounds)
    drawn: dict[str, tuple] = {}
    if fields.value is not None:
        drawn["value"] = (fields.value, problem.exact_value)
        drawn["slack"] = (slack_function(problem, fields.value), None)
    for kind, law in laws.items():
        drawn[f"control_{kind}"] = (law, problem.exact_control)
    if occupation is not None:
        drawn["occupation"] = (occupation_density(occupation, problem, fields, bounds), problem.exact_occupation)
    return drawn


def draw(problem: Problem, fields: Fields, bounds: Bounds, occupation: str | None) -> dict[str, Figure]:
    """A figure per quantity; in three and more dimensions a cut along the first two coordinates through 1/2."""
    plot = _curve if problem.dim == 1 else _map
    drawn = quantities(problem, fields, bounds, occupation)
    return {name: plot(problem.dim, TITLES[name], *functions) for name, functions in drawn.items()}


def save(figures: dict[str, Figure], folder: Path) -> None:
    """Write `figures/<name>.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(folder / f"{name}.png", dpi=120)


def _figure(columns: int):
    figure = Figure(figsize=(5.2 * columns, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def _components(function: Callable[[Tensor], Tensor | None], x: Tensor) -> Tensor | None:
    """Values as columns ``(N, k)``; an infinite one becomes a gap in the plot."""
    with torch.no_grad():
        if function is None or function(x[:1]) is None:
            return None
        values = batched(function, x)
    return values.reshape(len(x), -1).where(torch.isfinite(values.reshape(len(x), -1)), torch.nan)


def _curve(dim: int, title: str, learned, exact) -> Figure:
    x = torch.linspace(0.0, 1.0, LINE_POINTS, dtype=torch.float64).unsqueeze(-1)
    figure, (axis,) = _figure(1)
    axis.plot(x, _components(learned, x), label="learned")
    truth = _components(exact, x)
    if truth is not None:
        axis.plot(x, truth, "k:", label="exact")
        axis.legend()
    axis.set(title=title, xlabel="x")
    return figure


def _map(dim: int, title: str, learned, exact) -> Figure:
    line = (torch.arange(MAP_POINTS, dtype=torch.float64) + 0.5) / MAP_POINTS
    x = torch.full((MAP_POINTS**2, dim), 0.5, dtype=torch.float64)
    x[:, :2] = torch.cartesian_prod(line, line)
    panels = {"": _components(learned, x), ", exact": _components(exact, x)}
    panels = {suffix: values for suffix, values in panels.items() if values is not None}
    # A control of several components is drawn as its size, with arrows for its first two.
    sizes = {suffix: v.norm(dim=-1) if v.shape[1] > 1 else v[:, 0] for suffix, v in panels.items()}
    low = min(float(s.nan_to_num(nan=torch.inf).min()) for s in sizes.values())
    high = max(float(s.nan_to_num(nan=-torch.inf).max()) for s in sizes.values())
    figure, axes = _figure(len(panels))
    for axis, (suffix, values) in zip(axes, panels.items(), strict=True):
        grid = sizes[suffix].reshape(MAP_POINTS, MAP_POINTS).T
        image = axis.imshow(grid, origin="lower", extent=(0, 1, 0, 1), vmin=low, vmax=high)
        if values.shape[1] > 1:
            stride = MAP_POINTS // 16
            arrows = values[:, :2].reshape(MAP_POINTS, MAP_POINTS, 2)[::stride, ::stride]
            axis.quiver(line[::stride], line[::stride], arrows[..., 0].T, arrows[..., 1].T, color="w")
        name = f"|{title}|" if values.shape[1] > 1 else title
        axis.set(title=name + suffix, xlabel="$x_1$", ylabel="$x_2$")
        figure.colorbar(image, ax=axis)
    return figure
