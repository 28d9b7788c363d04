"""SVG charts of curves along the steps of a run."""

import math
from collections.abc import Sequence

from ocp_torch.certificate.settings import LONGEST_NAME
from ocp_torch.runs.report.drawings import AXIS, digits, dot, line, svg, write
from ocp_torch.runs.report.page import COLORS, text

CHART = 170  # height in pixels
MOST_LINES = COLORS
MARKED = 12  # curves of no more points than this have a dot at each


def chart(series: dict[str, list[tuple[float, float]]], log: bool = False, span: Sequence[float] = ()) -> str:
    """SVG of curves of points ``(step, value)`` by name, with their legend; the vertical axis covers the values ``span``, by
    default all values. Empty where there is nothing to draw."""
    keep = lambda y: math.isfinite(y) and (y > 0.0 or not log)
    lines = {n: [(x, y) for x, y in points if keep(y)] for n, points in list(series.items())[:MOST_LINES]}
    lines = {name: points for name, points in lines.items() if points}
    heights = [v for v in span if keep(v)] or [y for points in lines.values() for _, y in points]
    if not lines or not heights:
        return ""
    scale = math.log10 if log else float
    low, high = min(map(scale, heights)), max(map(scale, heights))
    spare = 0.12 * (high - low) or 0.05 * abs(high) or 1.0
    low, high = low - spare, high + spare
    last = max(x for points in lines.values() for x, _ in points) or 1
    at = lambda x, y: (1000.0 * x / last, 1000.0 * (high - scale(y)) / (high - low))
    parts, legend = [], []
    for t in (0.1, 0.53, 0.96):
        value = high - t * (high - low)
        shown = f"{10**value:.1e}" if log else digits(value, high - low)
        parts += [line(0, t * CHART, 100, t * CHART, "grid"), write(0, t * CHART - 3, shown, kind="soft")]
    for k, (name, points) in enumerate(lines.items()):
        places = [at(x, y) for x, y in points]
        drawn = " ".join(f"{x:.1f},{min(max(y, -9e3), 9e3):.1f}" for x, y in places)
        box = (
            f'viewBox="0 0 1000 1000" width="100%" height="{CHART}" preserveAspectRatio="none" style="overflow:hidden"'
        )
        parts.append(f'<svg {box}><polyline class="c{k}" vector-effect="non-scaling-stroke" points="{drawn}"/></svg>')
        inside = [(x, y) for x, y in places if 0.0 <= y <= 1000.0] if len(places) <= MARKED else []
        parts += [dot(x / 10.0, y * CHART / 1000.0, f"c{k}", 2.5) for x, y in inside]
        legend.append(f'<span><i class="c{k}"></i>{text(name, LONGEST_NAME)}</span>')
    parts += [write(0, CHART + 16, "0", kind="soft"), write(100, CHART + 16, f"step {last:,g}", "end", "soft")]
    return svg(CHART + AXIS, parts, "curves") + f'<p class="soft legend">{"".join(legend)}</p>'
