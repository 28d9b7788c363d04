"""Drawings of the bracket around the optimum of one run, and of the gaps of many."""

import math
from collections.abc import Sequence

from ocp_torch.runs.report.drawings import AXIS, digits, dot, line, svg, ticks, write
from ocp_torch.runs.report.words import label, number

# Height of a row in pixels.
ROW = 42


def bracket(certificate: dict) -> str:
    """SVG of the bounds, `OPT` where known, and performances, a row each, and the band between the best lower and upper one.

    Filled dots count, open ones would if a guess were right; bounds that are not used are left out. Values far from the band
    become arrows at the edge."""
    gap, exact = certificate["gap"], certificate["exact"]
    rows = [
        (label(side, n), e, k)
        for side, k in (("lower", 0), ("perf", 2), ("upper", 1))
        for n, e in _known(certificate, side)
        if e.get("counts", True) or "if" in e
    ]
    rows += [("doing nothing", e, 5) for _, e in _known(certificate, "baseline")]
    if not rows:
        return ""
    perf = dict(_known(certificate, "perf")).get(str(certificate.get("controller")))
    under = certificate["lower"][gap["lower_from"]]["interval"][0] if gap["lower_from"] else None
    above = [certificate["upper"][gap["upper_from"]]] if gap["upper_from"] else []
    over = min((e["interval"][1] for e in (*above, *([perf] if perf else []))), default=None)
    tight = [number(v) for v in (under, over, exact, *(perf["interval"] if perf else ())) if v is not None]
    tight = tight or [number(v) for _, e, _ in rows for v in e["interval"]]
    room = max(0.7 * (max(tight) - min(tight)), 1e-4 * max(map(abs, tight)), 1e-12)
    left, right = min(tight) - room, max(tight) + room
    at = lambda v: min(98.5, max(1.5, 1.5 + 97.0 * (v - left) / (right - left)))
    marks = [digits(v, right - left) for v in (left, 0.5 * (left + right), right)]
    height, parts = ROW * len(rows), list[str]()
    if under is not None and over is not None and under < over:
        parts.append(f'<rect class="band" x="{at(under):.2f}%" width="{at(over) - at(under):.2f}%" height="{height}"/>')
    if exact is not None:
        parts += [line(at(exact), 0, at(exact), height, "known"), write(at(exact), height + 34, "OPT", "middle")]
    for k, (name, e, color) in enumerate(rows):
        value, (low, high), y = number(e["value"]), e["interval"], ROW * k
        parts += [write(0, y + 13, name), write(100, y + 13, f"{value:.7g} ± {high - value:.1e}", "end", "soft")]
        parts.append(line(0, y + 24, 100, y + 24, "grid"))
        if left <= value <= right:
            parts.append(line(at(low), y + 24, at(high), y + 24, f"c{color}"))
            parts.append(dot(at(value), y + 24, f"c{color}" + ("" if e.get("counts", True) else " open")))
        else:
            side, word, anchor = (0, "◂", "start") if value < left else (100, "▸", "end")
            parts.append(write(side, y + 28, word, anchor))
    return svg(height + AXIS + 16, [*parts, *ticks(marks, height + 16)], "the bracket around the optimum")


def _known(certificate: dict, side: str) -> list[tuple[str, dict]]:
    return [(name, e) for name, e in certificate[side].items() if e]


def gaps(rows: Sequence[dict]) -> str:
    """The certified (filled) and the simulated gap (open) of each of the ``rows`` of a comparison, on a logarithmic line."""
    names = ("gap_certified", "gap_simulated")
    sizes = [row[name] for row in rows for name in names if row[name] is not None and row[name] > 0.0]
    if not sizes:
        return ""
    left, right = 10.0 ** math.floor(math.log10(min(sizes))), 10.0 ** math.ceil(math.log10(1.0001 * max(sizes)))
    at = lambda v: 1.0 + 98.0 * math.log(max(v, left) / left) / math.log(right / left)
    parts = []
    for k, row in enumerate(rows):
        shown, y = [row[name] for name in names], ROW * k
        parts += [write(0, y + 13, row["run"]), line(0, y + 24, 100, y + 24, "grid")]
        known = [v for v in shown if v is not None]
        if not known:
            parts.append(write(100, y + 13, "no gap", "end", "soft"))
        parts += [line(at(min(known)), y + 24, at(max(known)), y + 24, "c0")] if len(known) == 2 else []
        parts += [dot(at(v), y + 24, kind) for v, kind in zip(shown, ("c0", "c0 open"), strict=True) if v is not None]
    height = ROW * len(rows)
    marks = [f"{float(f'{100.0 * v:.2g}'):,g} %" for v in (left, math.sqrt(left * right), right)]
    parts += ticks(marks, height + 16)
    return svg(height + AXIS, parts, "gaps of the runs")
