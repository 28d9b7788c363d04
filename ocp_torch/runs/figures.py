"""Figures of `V`, `u`, `mu` and the HJB slack: curves in one dimension, maps over two coordinates beyond."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ocp_torch.certificate.lower.shifted import slack_function
from ocp_torch.certificate.trained import in_float64
from ocp_torch.control.policies import NETWORK, occupation_density, trained_policies
from ocp_torch.fields import Fields
from ocp_torch.files.storage import write_atomically
from ocp_torch.maths.runge_kutta import rate_at
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import batched
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.starts import initial_points
from ocp_torch.runs.canvas import blank_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE_POINTS, MAP_POINTS = 400, 80
# Of the simulated occupation density: bins a coordinate by dimension, starts, steps of a trajectory.
BINS, STARTS, FIGURE_STEPS = {1: 50, 2: 20}, 2048, 16
TITLES = {
    "value": "V",
    "control_value": "u from V",
    "control_density": "u = w / mu",
    "occupation": "mu",
    "slack": "HJB slack Q",
}


def quantities(problem: Problem, fields: Fields, constants: Constants, occupation: str | None) -> dict[str, tuple]:
    """Name -> (learned function, exact function or None), for what the fields give."""
    fields = in_float64(fields)
    policies = trained_policies(occupation, problem, fields, constants)
    drawn: dict[str, tuple] = {}
    if fields.value is not None:
        drawn["value"] = (fields.value, problem.exact_value)
        if problem.has_simulator:
            drawn["slack"] = (slack_function(problem, fields.value), None)
    for kind, policy in policies.items():
        if kind != "value" or problem.knows_control_matrix:
            drawn[f"control_{kind}"] = (policy, problem.exact_control)
    if occupation is not None and (problem.has_simulator or occupation == NETWORK):
        drawn["occupation"] = (occupation_density(occupation, problem, fields, constants), problem.exact_occupation)
    if problem.dim in BINS and problem.has_simulator:
        learned, exact = drawn.get("occupation", (None, problem.exact_occupation))
        drawn["occupation"] = (learned, exact, simulated_occupation(problem, next(iter(policies.values()))))
    return drawn


@torch.no_grad()
def simulated_occupation(
    problem: Problem, policy: Callable[[Tensor], Tensor], seed: int = 0
) -> Callable[[Tensor], Tensor]:
    """A histogram of `mu^u`, for one or two coordinates: where the closed loop of ``policy`` is at a time `T ~ Exp(rho)`.

    Starts weigh `mu0`; their number and the bins are few enough for a fraction of a second.
    """
    bins = BINS[problem.dim]
    points, start_mass = initial_points(problem, STARTS, 0, derive_seed(seed, Branch.FIGURES), extra=1)
    x0, times = points[:, :-1], -torch.log1p(-points[:, -1]) / problem.discount
    _, end = rate_at(lambda x: (problem.velocity(x, policy(x)), x[:, 0]), x0, problem.discount, times, FIGURE_STEPS)
    cell = lambda x: ((x * bins).long().clamp(0, bins - 1) * bins ** torch.arange(problem.dim)).sum(dim=-1)
    mass = torch.zeros(bins**problem.dim, dtype=torch.float64)
    mass.index_add_(0, cell(end), start_mass)
    density = mass * bins**problem.dim / STARTS
    return lambda x: density[cell(x.remainder(1.0))]


def draw(problem: Problem, fields: Fields, constants: Constants, occupation: str | None) -> dict[str, Figure]:
    """A figure per quantity; in three and more dimensions a cut along the first two coordinates through 1/2."""
    plot = _curve if problem.dim == 1 else _map
    drawn = quantities(problem, fields, constants, occupation)
    return {name: plot(problem.dim, TITLES[name], *functions) for name, functions in drawn.items()}


def save(figures: dict[str, Figure], folder: Path) -> None:
    """Write `figures/<name>.png`."""
    for name, figure in figures.items():
        write_atomically(folder / f"{name}.png", partial(figure.savefig, dpi=120, format="png"))


def _figure(columns: int):
    figure = blank_figure(5.2 * columns, 4.0)
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def _components(function: Callable[[Tensor], Any] | None, x: Tensor) -> Tensor | None:
    """Values as columns ``(N, k)``; an infinite one becomes a gap in the plot."""
    with torch.no_grad():
        if function is None or function(x[:1]) is None:
            return None
        values = batched(function, x)
    return values.reshape(len(x), -1).where(torch.isfinite(values.reshape(len(x), -1)), torch.nan)


def _curve(dim: int, title: str, learned, exact, simulated=None) -> Figure:
    x = torch.linspace(0.0, 1.0, LINE_POINTS, dtype=torch.float64).unsqueeze(-1)
    figure, (axis,) = _figure(1)
    forms = (("simulated", simulated, "C7"), ("learned", learned, "C0"), ("exact", exact, "k:"))
    for label, function, form in forms:
        values = _components(function, x)
        if values is not None:
            axis.plot(x, values, form, label=label)
    if len(axis.lines) > 1:
        axis.legend()
    axis.set(title=title, xlabel="x")
    return figure


def _map(dim: int, title: str, learned, exact, simulated=None) -> Figure:
    line = (torch.arange(MAP_POINTS, dtype=torch.float64) + 0.5) / MAP_POINTS
    x = torch.full((MAP_POINTS**2, dim), 0.5, dtype=torch.float64)
    x[:, :2] = torch.cartesian_prod(line, line)
    functions = {"": learned, ", exact": exact, ", simulated": simulated}
    known = {suffix: _components(function, x) for suffix, function in functions.items()}
    panels = {suffix: values for suffix, values in known.items() if values is not None}
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
