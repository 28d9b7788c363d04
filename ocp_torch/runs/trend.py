"""Plots of the gaps of runs against a number of their configurations, such as a noise level, a budget or a size."""

from itertools import groupby
from pathlib import Path
from typing import Any

from ocp_torch.errors import InputError, shown
from ocp_torch.runs.canvas import blank_figure, save_figure
from ocp_torch.runs.compare import Comparison, number
from ocp_torch.runs.configuration import saved_configuration

# Column of a comparison -> style of its line.
GAPS: dict[str, dict[str, Any]] = {
    "gap_certified": dict(linestyle="-", marker="o"),
    "gap_simulated": dict(linestyle=":", marker="x"),
}


def field_of(folder: Path, field: str) -> float:
    """The number ``field``, such as `problem.noise`, of the run in ``folder``. Raises `InputError` where there is none."""
    value: Any = saved_configuration(folder)
    try:
        for part in field.split("."):
            value = value[part]
        return number(value)
    except (LookupError, TypeError, ValueError):
        raise InputError(f"against is {shown(field)}, but {folder} has no such number in its configuration.") from None


def save_trend(comparison: Comparison, field: str, file: Path) -> None:
    """One line for each problem and method of ``comparison``, through the mean of the runs that share a value of ``field``;
    raises `InputError` where a run has no such number, or ``file`` is no picture."""
    points = [(field_of(comparison.folders[row["run"]], field), row) for row in comparison.rows]
    figure = blank_figure(6.4, 3.6)
    axis = figure.subplots()
    kind = lambda point: (point[1]["problem"], point[1]["method"])
    for k, ((problem, method), group) in enumerate(groupby(sorted(points, key=kind), key=kind)):
        members = list(group)
        for gap, look in GAPS.items():
            known = [(x, row[gap]) for x, row in members if row[gap] is not None]
            xs = sorted({x for x, _ in known})
            means = [100.0 * sum(g for at, g in known if at == x) / sum(at == x for at, _ in known) for x in xs]
            axis.plot(xs, means, color=f"C{k}", label=f"{problem}, {method}, {gap[4:]}", **look)
    above = [x for x, _ in points if x > 0.0]
    if above and all(x >= 0.0 for x, _ in points):  # a logarithmic axis, with 0 a step before the first number
        axis.set_xscale("symlog", linthresh=min(above), linscale=0.5)
    axis.set(yscale="log", ylabel="gap, %")
    axis.set_xlabel(field, parse_math=False)
    axis.legend(fontsize="small")
    save_figure(figure, file, "plot")
