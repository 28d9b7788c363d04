"""Every figure of the paper's numerical sections, and the cost of a step in both forms."""

import numpy as np
import torch

from ocp_torch.control.policies import occupation_density, trained_policies
from ocp_torch.problems import Circle
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.studies.benchmark.contenders import OCCUPATION
from ocp_torch.studies.paper.runs import Comparison, History, circle, truth

DISCOUNTS = (0.5, 1.0, 1.5, 2.0, 4.0)
LABELS = {
    "F_M": "$F_M(\\bar V_n)$",
    "J": "$J(\\bar w_n, \\mu_n)$",
    "G": "$G(\\bar w_n)$",
    "value": "Perf of the controller from $\\bar V_n$",
    "density": "Perf of $\\bar w_n / \\mu_n$",
}


def _figure(columns: int, rows: int = 1, width: float = 5.0):
    figure = blank_figure(width * columns, 3.8 * rows)
    return figure, figure.subplots(rows, columns, squeeze=False).ravel()


def _grid(count: int = 601) -> torch.Tensor:
    """States that miss the kink at 0 and the singularity of some densities at 1/2."""
    return ((torch.arange(count, dtype=torch.float64) + 0.5) / count).unsqueeze(-1)


def optimal_occupation():
    """A figure of `mu*` for several discounts: bounded exactly when `rho > 1`."""
    figure, (axis,) = _figure(1, width=6.0)
    x = _grid(2000)
    for rho in DISCOUNTS:
        axis.plot(x, Circle(rho).exact_occupation(x), label=f"$\\rho = {rho:g}$")
    axis.set(ylim=(0.0, 5.0), xlabel="x", title="$\\mu^*$")
    axis.legend()
    return figure


def evolution(history: History):
    """Costs and performances against the number of steps, in units of `OPT` and as distances from it; bands are seeds."""
    figure, (axis, distance) = _figure(2)
    recipe, looks = history.recipe, list(history.numbers)
    for k, name in enumerate(recipe.numbers):
        for where, shown in ((axis, lambda percent: 1.0 + percent / 100.0), (distance, abs)):
            rows = [[shown(m[name]) for m in history.numbers[n] if name in m] for n in looks]
            where.plot(looks, [np.median(row) for row in rows], marker=".", color=f"C{k}", label=LABELS[name])
            if min(map(len, rows)) > 1:
                where.fill_between(looks, list(map(min, rows)), list(map(max, rows)), color=f"C{k}", alpha=0.2)
    axis.axhline(1.0, color="k", linestyle=":", label="OPT")
    axis.set(xscale="log", xlabel="n", title=f"{recipe.name}, section {recipe.section}: cost / OPT")
    axis.set_ylim(0.4, 2.6 if "J" in recipe.numbers else 1.4)
    axis.legend(fontsize=8)
    distance.set(xscale="log", yscale="log", xlabel="n", title="distance to OPT, %")
    distance.grid(alpha=0.3)
    return figure


@torch.no_grad()
def iterates(history: History):
    """The learned functions for growing `n` beside the exact ones: `V` or `w` and the controller; all four for pd."""
    problem, constants = circle(history.recipe.noise)
    kind, x = OCCUPATION[history.recipe.method], _grid()
    V, u, mu = truth(history.recipe.noise).at(x)
    value, density = "controller from $\\bar V_n$", "controller $\\bar w_n / \\mu_n$"
    exact = {"$\\bar w_n$": u[:, 0] * mu, "$\\bar V_n$": V, "$\\mu_n$": mu, value: u, density: u}

    def learned(fields) -> dict[str, torch.Tensor]:
        policies = trained_policies(kind, problem, fields, constants)
        drawn = {}
        if fields.control_density is not None:
            drawn["$\\bar w_n$"] = fields.control_density(x)
        if fields.value is not None:
            drawn["$\\bar V_n$"] = fields.value(x)
        if history.recipe.method == "pd":
            drawn["$\\mu_n$"] = occupation_density(kind, problem, fields, constants)(x)
        title, policy = (density, "density") if "density" in policies else (value, "value")
        return drawn | {title: policies[policy](x)}

    curves = {n: learned(fields) for n, fields in history.fields.items()}
    titles = list(next(iter(curves.values())))
    figure, axes = _figure(2, len(titles) // 2)
    for axis, title in zip(axes, titles, strict=True):
        for k, (n, drawn) in enumerate(curves.items()):
            grey = max(0.0, 0.8 - 0.8 * k / max(1, len(curves) - 1))
            axis.plot(x, drawn[title], color=(grey,) * 3, label=f"n = {n:,}")
        axis.plot(x, exact[title], "r:", linewidth=2.0, label="exact")
        axis.set(title=title, xlabel="x")
    axes[0].legend(fontsize=8)
    return figure


def costs(comparisons: list[Comparison]):
    """CPU time per step against `n`: it grows for the exact kernel, and does not for truncated features."""
    figure, (axis,) = _figure(1, width=6.0)
    for k, c in enumerate(comparisons):
        for form, style in (("exact", "-"), ("truncated", "--")):
            n, seconds = zip(*c.costs[form], strict=True)
            axis.plot(n, 1e6 * np.array(seconds), style, color=f"C{k}", label=f"{c.method}, {form}", marker=".")
    axis.set(xlabel="n", ylabel="CPU time per step, µs", ylim=(0.0, None))
    axis.legend()
    return figure
