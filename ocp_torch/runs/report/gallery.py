"""`gallery.html`: systems on one page, each with its picture, bracket, training time and training command."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ocp_torch.errors import InputError, require_number, require_section
from ocp_torch.files.reading import kind, read_json
from ocp_torch.files.storage import write_atomically
from ocp_torch.problems import Problem
from ocp_torch.runs.compare import row_of
from ocp_torch.runs.report.many import linked, said
from ocp_torch.runs.report.page import code, image, page, paragraph, section, table, text
from ocp_torch.runs.report.problem import described
from ocp_torch.runs.report.report import drawn
from ocp_torch.runs.report.sections import FIGURES
from ocp_torch.runs.report.words import percent, sentence

SECONDS = "seconds.json"
COLUMNS = ("system", "certified gap", "simulated gap", "seconds")


@dataclass(frozen=True)
class Exhibit:
    """A system of a gallery: its ``problem``, the ``folder`` of its run, the ``command`` that makes such a run alone, and the
    reason why it ``failed``, if it did."""

    name: str
    problem: Problem
    folder: Path
    command: str
    failed: str | None = None


def seconds_in(folder: Path) -> dict[str, float]:
    """The seconds that each system of the gallery in ``folder`` took so far. Raises `InputError` for a damaged file."""
    file = folder / SECONDS
    found = require_section(str(file), read_json(file)) if kind(file) is not None else {}
    return {name: require_number(f"{file}: {name}", value, at_least=0.0) for name, value in found.items()}


def save_gallery(exhibits: Sequence[Exhibit], seconds: dict[str, float], file: Path) -> None:
    """Write the page ``file``, which links to the reports of the runs, and the ``seconds`` of each beside it."""
    parts = [
        "<h1>Gallery</h1>",
        paragraph(text(_counted(exhibits, seconds)), "soft"),
        table(COLUMNS, [_row(one, seconds) for one in exhibits], range(1, len(COLUMNS))),
        *(_card(one, seconds.get(one.name), file.absolute().parent) for one in exhibits),
    ]
    html, times = page("gallery", parts), json.dumps(seconds, indent=1)
    write_atomically(file.parent / SECONDS, lambda path: path.write_text(times, encoding="utf-8"))
    write_atomically(file, lambda path: path.write_text(html, encoding="utf-8"))


def _counted(exhibits: Sequence[Exhibit], seconds: dict[str, float]) -> str:
    done = [seconds[one.name] for one in exhibits if one.name in seconds]
    failed = [one.name for one in exhibits if one.failed]
    told = f"{len(done)} of {len(exhibits)} systems, one after the other, in {sum(done):,.0f} s"
    return sentence(told + (f"; failed: {', '.join(failed)}" if failed else ""))


def _row(exhibit: Exhibit, seconds: dict[str, float]) -> list[str]:
    """The exhibit's row of the table, with its gaps where there are some."""
    name = exhibit.name
    try:
        row = row_of(exhibit.folder, name)
        gaps = ["none" if row[gap] is None else percent(row[gap]) for gap in ("gap_certified", "gap_simulated")]
    except InputError:  # its card says why
        gaps = ["", ""]
    spent = f"{seconds[name]:,.0f}" if name in seconds else ""
    return [f'<a href="#{text(name)}">{text(name)}</a>', *map(text, gaps), spent]


def _card(exhibit: Exhibit, seconds: float | None, place: Path) -> str:
    parts = [described(exhibit.problem, {})[0]]
    if exhibit.failed:
        parts.append(paragraph(text(sentence(f"it failed: {exhibit.failed}")), "lead alert"))
    if seconds is None:
        parts.append(paragraph("It has not been trained yet."))
    elif kind(exhibit.folder / "certificate.json") is not None:
        parts += [picture(exhibit.folder), said(exhibit.folder)]
    spent = "To" if seconds is None else f"{seconds:,.0f} s for training, certificate and figures. To"
    parts += [paragraph(f"{spent} train it alone:"), code(exhibit.command), linked(exhibit.folder, place)]
    return f'<div id="{text(exhibit.name)}"></div>{section(exhibit.name, *parts)}'


def picture(folder: Path) -> str:
    """The run's figure of the motion, or else its map of `V`; empty without either."""
    figures = drawn(folder)
    for start in ("motion", "value"):
        for name in sorted(figures):
            if name.startswith(start):
                return f'<div class="figures">{image(figures[name], FIGURES[start])}</div>'
    return ""
