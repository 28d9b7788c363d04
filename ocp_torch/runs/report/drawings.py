"""SVG pictures of any width, with the colours of the page: horizontal places are in per cent, vertical ones in pixels."""

import math
from collections.abc import Sequence

from ocp_torch.certificate.settings import LONGEST_NAME
from ocp_torch.runs.report.page import text

# Height in pixels of the axis below a picture.
AXIS = 22


def svg(height: float, parts: Sequence[str], what: str) -> str:
    inner = "\n".join(parts)
    return f'<svg width="100%" height="{height:g}" role="img" aria-label="{text(what)}">\n{inner}\n</svg>'


def line(x1: float, y1: float, x2: float, y2: float, kind: str) -> str:
    return f'<line class="{kind}" x1="{x1:.2f}%" y1="{y1:g}" x2="{x2:.2f}%" y2="{y2:g}"/>'


def dot(x: float, y: float, kind: str, radius: float = 4.5) -> str:
    return f'<circle class="{kind}" stroke-width="1.6" cx="{x:.2f}%" cy="{y:g}" r="{radius:g}"/>'


def write(x: float, y: float, words: str, anchor: str = "start", kind: str = "") -> str:
    return f'<text class="{kind}" x="{x:.2f}%" y="{y:g}" text-anchor="{anchor}">{text(words, 2 * LONGEST_NAME)}</text>'


def ticks(marks: Sequence[str], y: float) -> list[str]:
    """Three labels ``marks`` at the height ``y``: at the left end, in the middle and at the right end."""
    places = ((0.0, "start"), (50.0, "middle"), (100.0, "end"))
    return [write(x, y, mark, anchor, "soft") for mark, (x, anchor) in zip(marks, places, strict=True)]


def digits(value: float, span: float) -> str:
    """``value`` with as many decimals as a range of length ``span`` needs."""
    if not span > 0.0 or max(abs(value), span) >= 1e6:
        return f"{value:.3g}"
    return f"{value:.{min(12, max(0, 2 - math.floor(math.log10(span))))}f}"
