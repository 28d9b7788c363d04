"""Many runs on one page: their table, a picture of their gaps, and the first sentence and bracket of each."""

import os
from pathlib import Path
from urllib.parse import quote

from ocp_torch.errors import InputError
from ocp_torch.files.reading import FILE, kind, read_json
from ocp_torch.files.storage import write_atomically
from ocp_torch.runs.compare import COLUMNS, LARGEST_CERTIFICATE, Comparison
from ocp_torch.runs.report.bracket import bracket, gaps
from ocp_torch.runs.report.lead import lead
from ocp_torch.runs.report.page import page, paragraph, section, table, text
from ocp_torch.runs.report.report import DAMAGE, REPORT, reason
from ocp_torch.runs.report.words import percent

FIRST = ("run", "gap_certified", "gap_simulated", "share")


def save_page(comparison: Comparison, file: Path) -> None:
    """Write ``comparison`` as the page ``file``, which links to the reports of the runs; `InputError` unless it ends in
    `.html`."""
    if file.suffix.lower() != ".html":
        raise InputError(f"html is {str(file)!r}, but must end in .html.")
    html = page("runs", _parts(comparison, file.absolute().parent))
    write_atomically(file, lambda path: path.write_text(html, encoding="utf-8"))


def _parts(comparison: Comparison, place: Path) -> list[str]:
    rows = comparison.rows
    # The columns that runs are ranked by come first, where they fit on any screen.
    order = [*FIRST, *(name for name in COLUMNS if name not in FIRST)]
    shown = (dict(zip(COLUMNS, line, strict=True)) for line in comparison.cells)
    cells = [[text(line[name]) for name in order] for line in shown]
    best = rows[0] if rows and rows[0]["gap_certified"] is not None else None
    said = f"The smallest certified gap is {percent(best['gap_certified'])}, of {best['run']}." if best else None
    missing = [paragraph(f"{text(run)}: {text(why)}") for run, why in comparison.unfinished.items()]
    note = "Filled dots are certified gaps, open ones simulated."
    return [
        f"<h1>{len(rows)} {'run' if len(rows) == 1 else 'runs'}</h1>",
        paragraph(text(said or "No run has a certified gap."), "lead" if said else "lead alert"),
        section("Table", table([name.replace("_", " ") for name in order], cells, range(1, len(order))))
        if rows
        else "",
        section("Gaps", gaps(rows), paragraph(note, "soft")) if rows else "",
        section("Each run", *(_one(row, comparison.folders[row["run"]], place) for row in rows)),
        section("Not in the table", *missing),
    ]


def _one(row: dict, folder: Path, place: Path) -> str:
    """A run's sentence and bracket, folded, with a link to its report where there is one."""
    told = said(folder) + linked(folder, place)
    gap = next((row[name] for name in ("gap_certified", "gap_simulated") if row[name] is not None), None)
    head = f"{row['run']}: {row['problem']}, {row['method']}, {'no gap' if gap is None else percent(gap)}"
    return f"<details><summary>{text(head)}</summary>{told}</details>"


def said(folder: Path) -> str:
    """The first sentence and the bracket of the run in ``folder``, or why they cannot be shown."""
    try:
        certificate = read_json(folder / "certificate.json", LARGEST_CERTIFICATE)
        return paragraph(text(lead(certificate))) + bracket(certificate)
    except DAMAGE as error:
        return paragraph(text(f"It cannot be shown: {reason(error)}."))


def linked(folder: Path, place: Path) -> str:
    """A link from a page in the folder ``place`` to the report of the run in ``folder``, where there is one."""
    if kind(folder / REPORT) != FILE:
        return ""
    link = quote(os.path.relpath((folder / REPORT).absolute(), place))
    return paragraph(f'<a href="{text(link)}">its report</a>')
