"""Curves of several seeds as a table and as plots."""

import math
from collections.abc import Sequence
from statistics import median

import numpy as np

from ocp_torch.certificate import LOWER, UPPER, bounds
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.studies.benchmark.measure import Curve, median_and_spread

# The contender whose certified gap all others are compared with: the paper's primal-dual.
BASELINE = "kernel pd"
# "Reaches 1 %" in the table: the performance stays within this part of the optimum.
TOLERANCE = 0.01


def reference(curves: list[Curve], exact: float | None) -> tuple[float, str]:
    """The number that sub-optimality is relative to, and its name: `OPT`, or where it is unknown the best lower bound."""
    if exact is not None:
        return exact, "OPT"
    found = [p.numbers[n] for c in curves for p in c.points for n in bounds.on(LOWER) if n in p.numbers]
    return max(found, default=math.nan), "the best lower bound found"


def by_contender(curves: list[Curve]) -> dict[str, list[Curve]]:
    return {name: [c for c in curves if c.contender == name] for name in dict.fromkeys(c.contender for c in curves)}


def contest_table(curves: list[Curve], exact: float | None) -> str:
    """A Markdown table: at each contender's end, median over seeds and, where there are several, smallest to largest."""
    optimum, what = reference(curves, exact)
    off = lambda number: 100.0 * (number / optimum - 1.0)
    groups = by_contender(curves)
    hits = {name: [hit for c in own if (hit := c.first_within(TOLERANCE, optimum))] for name, own in groups.items()}
    names = [n for side in (LOWER, UPPER) for n in bounds.on(side) if any(n in c.points[-1].numbers for c in curves)]
    heads = ["contender", "samples", "seconds", *names, "Perf", "gap, certified", "times smaller"]
    heads += ["1 % on Perf after samples", "seconds"]
    lines = [
        f"Per cent are relative to {what} = {optimum:.8g}; bounds and Perf are means over few states, the same for all, "
        "good to some .02 %; the gap is that of the full certificate at the end, relative "
        f"to the lower bound, and `times smaller` holds its median against that of {BASELINE}; where a certificate uses no "
        "upper bound (a controller that jumps), the gap between the columns stands in for it, marked *; seconds are CPU "
        "seconds of training, those of the certificate after the sign +.",
        "",
        f"| {' | '.join(heads)} |",
        "|---" * len(heads) + "|",
    ]
    widest = gaps(groups.get(BASELINE, []))
    for name, own in groups.items():
        ends, certified, reached = [c.points[-1] for c in own], gaps(own), hits[name]
        number = lambda key, ends=ends: spread([off(p.numbers[key]) for p in ends if key in p.numbers], "+.3g", " %")
        ratio = median(widest) / median(certified) if widest and certified else math.nan
        few = "" if len(reached) == len(own) else f" ({len(reached)} of {len(own)} seeds)"
        later = [c.certificate_seconds for c in own if c.certificate_seconds > 0.0]
        cells = [
            name,
            spread([p.samples for p in ends], ",.0f"),
            spread([p.seconds for p in ends], ".3g") + (f" + {median(later):.3g}" if later else ""),
            *map(number, names),
            spread([off(p.perf) for p in ends if math.isfinite(p.perf)], "+.3g", " %"),
            spread(certified, ".3g", " %") + ("*" if certified and any(c.certified is None for c in own) else ""),
            f"{ratio:.3g}" if math.isfinite(ratio) else "-",
            spread([p.samples for p in reached], ",.0f") + few if reached else "not reached",
            spread([p.seconds for p in reached], ".3g"),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    lines.append("")
    # The contender that reaches the tolerance first, by the median over seeds, among those that do so with every seed.
    sure = {name: reached for name, reached in hits.items() if len(reached) == len(groups[name])}
    for unit in ("samples", "seconds") if sure else ():
        medians = {name: median(getattr(hit, unit) for hit in reached) for name, reached in sure.items()}
        first = min(medians, key=medians.__getitem__)
        lines.append(f"1 % on Perf in the fewest {unit}: {first}, {medians[first]:,.6g}.")
    return "\n".join(lines)


def gaps(curves: list[Curve]) -> list[float]:
    """The certified gaps, in per cent; where a certificate has none, the gap of the bounds themselves, if there is one."""
    found = [c.certified if c.certified is not None else c.points[-1].gap for c in curves]
    return [100.0 * gap for gap in found if math.isfinite(gap)]


def spread(values: Sequence[float], form: str, unit: str = "") -> str:
    """`median [smallest, largest]`, or the one value, or a dash."""
    if not values:
        return "-"
    middle, low, high = (format(v, form) for v in median_and_spread(values))
    return f"{middle}{unit}" + (f" [{low}, {high}]" if low != high else "")


def plot(curves: list[Curve], exact: float | None):
    """Sub-optimality of the controller and the gap of the bounds, against samples and against CPU seconds."""
    optimum, what = reference(curves, exact)
    rows = {
        f"Perf above {what}, %": lambda p: 100.0 * (p.perf / optimum - 1.0),
        "gap between the best bounds, %": lambda p: 100.0 * p.gap,
    }
    columns = {"samples": lambda p: float(p.samples), "CPU seconds of training": lambda p: p.seconds}
    figure = blank_figure(11.0, 8.0)
    axes = figure.subplots(2, 2, sharey="row", sharex="col")
    for i, (label, height) in enumerate(rows.items()):
        for j, (unit, place) in enumerate(columns.items()):
            for k, (name, own) in enumerate(by_contender(curves).items()):
                draw(axes[i, j], own, place, height, f"C{k}", name)
            axes[i, j].set(xscale="log", yscale="log", xlabel=unit if i == 1 else "", ylabel=label if j == 0 else "")
            axes[i, j].grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    return figure


def draw(axis, curves: list[Curve], place, height, color: str, name: str) -> None:
    """Draw the median over seeds at each point, and the range of all seeds."""
    rows = list(zip(*(c.points for c in curves), strict=False))  # up to where the shortest run ends
    x = np.array([np.median([place(p) for p in row]) for row in rows])
    values = np.array([[height(p) for p in row] for row in rows])
    values[~np.isfinite(values) | (values <= 0.0)] = np.nan
    usable = ~np.isnan(values).any(axis=1) & (x > 0.0)
    if not usable.any():
        return
    x, values = x[usable], values[usable]
    axis.plot(x, np.median(values, axis=1), color=color, label=name, marker=".")
    axis.fill_between(x, values.min(axis=1), values.max(axis=1), color=color, alpha=0.2)
