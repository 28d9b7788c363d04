"""HTML pages of one file: the style is inside, nothing is fetched, and colours follow the reader's light or dark mode."""

import base64
import re
import struct
from collections.abc import Iterable, Sequence
from html import escape

from ocp_torch.errors import LONGEST, visible

# Figures are drawn at 120 dots per inch and shown at 96: this scale keeps their size.
SCALE = 0.8
# A figure of more pixels than this has a row of its own, and scrolls where the screen is narrower.
WIDE = 800

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1c232d; --soft: #5a6471; --line: #d8dde3; --panel: #f5f6f8;
  --accent: #1d5da8; --alert: #a33b12; --band: #1d5da822;
  --c0: #1d5da8; --c1: #b4431f; --c2: #2b7d46; --c3: #7c4fa3; --c4: #8a6a00; --c5: #55606d; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181d; --ink: #dfe4ea; --soft: #98a2ae; --line: #343b44;
  --panel: #1c2127; --accent: #7fb2ee; --alert: #f0926b; --band: #7fb2ee2b;
  --c0: #7fb2ee; --c1: #f0926b; --c2: #79c893; --c3: #c3a0e3; --c4: #d9bb58; --c5: #9aa5b1; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 48rem; padding: 1.5rem 1rem 4rem; background: var(--paper); color: var(--ink);
  font: 1rem/1.55 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 .2rem; } h2 { font-size: 1.2rem; margin: 2.4rem 0 .6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; } a { color: var(--accent); }
p { margin: .5rem 0; } .soft, figcaption, th { color: var(--soft); } .soft, figcaption, table, pre { font-size: .875rem; }
.lead { font-size: 1.15rem; line-height: 1.45; margin: 1.2rem 0; padding: .9rem 1rem; background: var(--panel);
  border-left: .25rem solid var(--accent); } .lead.alert { border-color: var(--alert); }
.formula { font-family: Cambria, "Latin Modern Math", "STIX Two Math", Georgia, serif; font-size: 1.05rem; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; min-width: 100%; }
th, td { text-align: left; vertical-align: top; padding: .35rem .8rem .35rem 0; border-bottom: 1px solid var(--line); }
th { font-weight: 500; white-space: nowrap; } td.n { white-space: nowrap; font-variant-numeric: tabular-nums; }
pre { overflow-x: auto; margin: .3rem 0 .8rem; padding: .7rem .8rem; background: var(--panel); line-height: 1.45; }
code, pre { font-family: ui-monospace, "SF Mono", Menlo, Consolas, "DejaVu Sans Mono", monospace; }
code { font-size: .9em; } dt { margin-top: .8rem; } dd { margin: .1rem 0 0; color: var(--soft); }
.facts dd { color: inherit; }
@media (min-width: 40rem) { .facts { display: grid; grid-template-columns: 7rem 1fr; gap: .2rem 1rem; }
  .facts dt, .facts dd { margin: 0; } }
.facts dt { color: var(--soft); } summary { cursor: pointer; margin: .5rem 0; }
figure { margin: .8rem 0 0; } img { max-width: 100%; height: auto; }
.figures { display: grid; grid-auto-flow: dense; gap: 0 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 20rem), 1fr)); }
.figures figure { background: #fff; color: #1c232d; border: 1px solid var(--line); padding: .5rem; min-width: 0; }
.figures figcaption { color: #5a6471; } .figures .wide { grid-column: 1 / -1; }
@media (max-width: 40rem) { .wide img { max-width: none; width: 40rem; } }
svg { display: block; overflow: visible; } svg text, svg .soft { font-size: 12px; fill: var(--ink); }
svg .soft { fill: var(--soft); } svg .grid { stroke: var(--line); } svg .band { fill: var(--band); }
svg .known { stroke: var(--ink); stroke-dasharray: 2 3; } svg polyline { fill: none; stroke-width: 1.6; }
.legend span { margin-right: 1rem; white-space: nowrap; } .legend i { display: inline-block; width: .9rem; height: .2rem;
  margin-right: .35rem; vertical-align: middle; }
@media print { body { max-width: none; } }
"""
COLORS = 6
STYLE += "".join(
    f"svg .c{k} {{ stroke: var(--c{k}); fill: var(--c{k}); }} svg .open.c{k} {{ fill: var(--paper); }} "
    f"polyline.c{k} {{ fill: none !important; }} i.c{k} {{ background: var(--c{k}); }}\n"
    for k in range(COLORS)
)


def text(value: object, most: int = LONGEST) -> str:
    """``value``, also from an untrusted file, as HTML that only shows it; shortened where it is longer than ``most``."""
    return escape(visible(value, most))


def prose(value: object) -> str:
    """`text` for sentences of this package and docstrings: words in back-ticks become code."""
    return re.sub(r"``(.+?)``|`(.+?)`", lambda m: f"<code>{m[1] or m[2]}</code>", text(" ".join(str(value).split())))


def paragraph(html: str, kind: str = "") -> str:
    return f'<p class="{kind}">{html}</p>' if kind else f"<p>{html}</p>"


def section(title: str, *parts: str) -> str:
    """The HTML ``parts`` under their ``title``, plain text; empty if all parts are."""
    filled = [part for part in parts if part]
    return "\n".join([f"<section><h2>{text(title)}</h2>", *filled, "</section>"]) if filled else ""


def table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()) -> str:
    """A table of HTML cells that scrolls if it is wide; the columns ``numbers`` do not wrap."""
    cell = lambda k, html: f'<td class="n">{html}</td>' if k in numbers else f"<td>{html}</td>"
    head = "".join(f"<th>{text(name)}</th>" for name in header)
    body = "\n".join(f"<tr>{''.join(cell(k, html) for k, html in enumerate(row))}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def listing(pairs: Iterable[tuple[str, str]], kind: str = "facts") -> str:
    """A list of ``pairs`` of a term and its meaning, both HTML."""
    return f'<dl class="{kind}">' + "".join(f"<dt>{term}</dt><dd>{meaning}</dd>" for term, meaning in pairs) + "</dl>"


def folded(summary: str, html: str) -> str:
    return f"<details><summary>{text(summary)}</summary>{html}</details>"


def code(lines: str) -> str:
    return f"<pre>{escape(lines)}</pre>"


def image(png: bytes, caption: str) -> str:
    """The bytes of a ``png`` file as a figure within the page."""
    width, height = (round(SCALE * n) for n in struct.unpack(">II", png[16:24]))
    kind = ' class="wide scroll"' if width > SCALE * WIDE else ""
    data = base64.b64encode(png).decode()
    size = f'width="{width}" height="{height}"'
    shown = f'<img {size} alt="{text(caption)}" src="data:image/png;base64,{data}">'
    return f"<figure{kind}>{shown}<figcaption>{text(caption)}</figcaption></figure>"


def page(title: str, parts: Iterable[str]) -> str:
    """The whole page as text."""
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n<main>\n"
    )
    return head + "\n".join(part for part in parts if part) + "\n</main>\n</body></html>\n"
