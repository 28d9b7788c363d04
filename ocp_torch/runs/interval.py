"""A certificate on a line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ocp_torch.certificate.settings import LONGEST_NAME
from ocp_torch.errors import visible
from ocp_torch.runs.canvas import blank_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def interval_figure(certificate: dict) -> Figure:
    """The certificate (as a dict of its schema) on a line: bounds, `OPT` where known and performances, with their intervals.

    What is much farther from the tightest of them than they are from one another is cut off, with an arrow and its value.
    """
    rows = [(f"{n} ≤ OPT", e, "C0") for n, e in certificate["lower"].items() if e]
    rows += [(f"Perf, {n}", e, "C2") for n, e in certificate["perf"].items() if e]
    rows += [(f"{n} ≤ Perf", e, "C4") for n, e in certificate.get("perf_lower", {}).items() if e]
    rows += [(f"≤ {n}", e, "C3") for n, e in certificate["upper"].items() if e]
    rows += [("doing nothing", e, "C7") for e in certificate["baseline"].values() if e]
    figure = blank_figure(7.0, 1.2 + 0.32 * max(len(rows), 1))
    axis = figure.subplots()
    lows, highs = ([e["value"] for e in certificate[side].values() if e] for side in ("lower", "perf"))
    highs = highs or [e["value"] for e in certificate["upper"].values() if e]
    ends = ([max(lows)] if lows else []) + ([min(highs)] if highs else [])
    ends += [certificate["exact"]] if certificate["exact"] is not None else []
    ends += [end for name, e, _ in rows if name.startswith("Perf") for end in e["interval"]]
    left, right = min(ends, default=0.0), max(ends, default=1.0)
    room = max(2.0 * (right - left), 1e-3 * max(abs(left), abs(right)), 1e-12)
    left, right = left - room, right + room
    axis.set_xlim(left, right)
    for y, (_, e, color) in enumerate(rows):
        outside = min(max(e["value"], left), right)
        if outside != e["value"]:
            marker, side = ("<", 1) if outside == left else (">", -1)
            axis.plot(outside, y, marker, color=color, clip_on=False)
            offset: dict[str, Any] = {"xytext": (8 * side, 0), "textcoords": "offset points"}
            at = "left" if side > 0 else "right"
            axis.annotate(f"{e['value']:.5g}", (outside, y), va="center", ha=at, **offset)
            continue
        axis.errorbar(e["value"], y, xerr=0.5 * (e["interval"][1] - e["interval"][0]), fmt="o", capsize=3, color=color)
    if certificate["exact"] is not None:
        axis.axvline(certificate["exact"], color="k", linestyle=":", label="OPT")
        axis.legend(loc="upper right")
    # A name may come from a file: its signs are not a formula.
    axis.set_yticks(range(len(rows)), [visible(name, LONGEST_NAME) for name, *_ in rows], parse_math=False)
    axis.invert_yaxis()
    title = f"{visible(certificate['problem'], LONGEST_NAME)}, {100 * certificate['confidence']:.4g} % intervals"
    axis.set_title(title, parse_math=False)
    return figure
