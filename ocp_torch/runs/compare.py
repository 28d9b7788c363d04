"""Runs side by side, the smallest gap first: their certificates as a table for the terminal, as CSV, and as a plot."""

import contextlib
import csv
import io
import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ocp_torch.certificate.report import WIDE
from ocp_torch.certificate.settings import LONGEST_NAME
from ocp_torch.errors import InputError, visible
from ocp_torch.files.reading import FOLDER, kind, read_json, read_text
from ocp_torch.files.storage import write_atomically
from ocp_torch.runs.canvas import blank_figure, save_figure
from ocp_torch.training.checkpoint import newest

LARGEST_CERTIFICATE = 2**22
LOG = "train.log"
LARGEST_LOG = 2**24  # bytes
FAILED = "error: "  # how the last line of the log of a failed job of a sweep begins
# Names come from untrusted files: control characters and overlong names must not reach the terminal.
printable = partial(visible, most=LONGEST_NAME)
# A number that would take more characters is shown with six digits.
WIDEST = 24
# Column -> format of its numbers.
COLUMNS = {
    "run": "",
    "problem": "",
    "method": "",
    "seed": "d",
    "step": ",d",
    "train_seconds": ".0f",
    "lower": ".6f",
    "perf": ".6f",
    "upper": ".6f",
    "exact": ".6f",
    "gap_certified": ".3%",
    "gap_simulated": ".3%",
    "share": ".1%",
    "stopped": "",
    "warnings": "d",
}


@dataclass(frozen=True)
class Comparison:
    """``rows`` of the columns `COLUMNS`, `None` where a number does not apply; ``unfinished``: for runs without a row, the
    reason; ``folders``: the folder of each run."""

    rows: list[dict]
    unfinished: dict[str, str]
    folders: dict[str, Path]

    @property
    def cells(self) -> list[list[str]]:
        """The formatted cells of each row."""
        return [[_shown(row[c], form) for c, form in COLUMNS.items()] for row in self.rows]

    def table(self) -> str:
        """The table for the terminal."""
        cells = [list(COLUMNS), *self.cells]
        widths = [max(len(line[k]) for line in cells) for k in range(len(COLUMNS))]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in cells]
        lines.insert(1, "-" * max(map(len, lines)))
        lines += [f"not in the table: {run}: {why}" for run, why in self.unfinished.items()]
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.table()

    def save_csv(self, file: Path) -> None:
        """Write the rows as CSV, with numbers in full precision, empty where they do not apply."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, COLUMNS)
        writer.writeheader()
        writer.writerows(self.rows)
        write_atomically(file, lambda path: path.write_text(text.getvalue(), newline=""))

    def save_plot(self, file: Path) -> None:
        """Draw, for every run, the range between the lower bound and each upper side."""
        figure = blank_figure(7.0, 1.2 + 0.4 * max(1, len(self.rows)))
        axis = figure.subplots()
        for k, row in enumerate(self.rows):
            for column, mark in (("lower", "|"), ("perf", "o"), ("upper", "|")):
                if row[column] is not None:
                    axis.plot(row[column], k, mark, color="C0", markersize=10 if mark == "|" else 5)
            known = [row[c] for c in ("lower", "perf", "upper") if row[c] is not None]
            axis.plot([min(known, default=0.0), max(known, default=0.0)], [k, k], color="C0", linewidth=1)
            if row["exact"] is not None:
                axis.plot(row["exact"], k, "kx", markersize=6)
        axis.set_yticks(range(len(self.rows)), [row["run"] for row in self.rows], parse_math=False)
        axis.invert_yaxis()
        axis.set(xlabel="lower bound | simulated performance o upper bound | (x: OPT)")
        save_figure(figure, file, "plot")


def _shown(value, form: str) -> str:
    if form.endswith("%") and value is not None and not 0.0 <= value <= WIDE:  # as a percentage it says nothing
        return "none" if value < 0.0 else f"{1.0 + value:.3g} times"
    text = "-" if value is None else format(value, form)
    return text if len(text) <= WIDEST or not isinstance(value, int | float) else f"{value:.6g}"


def compare(paths: Iterable[Path]) -> Comparison:
    """All runs in ``paths`` (run folders, or folders of them), sorted by the certified gap, then by the simulated one."""
    rows, unfinished, folders = list[dict](), dict[str, str](), list[Path]()
    for path in paths:
        if kind(path) != FOLDER:
            raise InputError(f"{path} is not a folder; give runs' folders, or folders that hold some.")
        found = run_folders(path)
        folders += found
        unfinished |= {} if found else {printable(path): "no run is in it."}
    if unfinished and not folders:
        raise InputError(f"no run is in {', '.join(unfinished)}; give runs' folders, or folders that hold some.")
    places = named(list(dict.fromkeys(folders)))
    for folder, name in places.items():
        try:
            rows.append(row_of(folder, name))
        except InputError as error:
            unfinished[name] = str(error)
    return Comparison(ranked(rows), unfinished, {name: folder for folder, name in places.items()})


def ranked(rows: list[dict]) -> list[dict]:
    """``rows``, the smallest gap first."""
    size = lambda gap: math.inf if gap is None else gap
    return sorted(rows, key=lambda row: (size(row["gap_certified"]), size(row["gap_simulated"])))


def run_folders(path: Path) -> list[Path]:
    """``path`` if it is a run's folder, else every run's folder below it."""
    marks = (".hydra", "checkpoints", "certificate.json")
    if any(kind(path / mark) is not None for mark in marks):
        return [path]
    return sorted({p.parent for mark in marks for p in path.rglob(mark) if "checkpoints" not in p.parent.parts[-1:]})


def named(folders: list[Path]) -> dict[Path, str]:
    """Each folder with a printable name: the part of its path that not all folders share."""
    parents = [list(folder.absolute().parts) for folder in folders]
    shared = 0
    while len(parents) > 1 and all(len(p) > shared + 1 for p in parents) and len({p[shared] for p in parents}) == 1:
        shared += 1
    keep = slice(shared, None) if len(parents) > 1 else slice(-1, None)
    return {f: printable("/".join(p[keep])) for f, p in zip(folders, parents, strict=True)}


def row_of(folder: Path, name: str) -> dict:
    """The row of one run. Raises `InputError` with the reason when it has no readable certificate."""
    file = folder / "certificate.json"
    if kind(file) is None:
        raise InputError(progress_of(folder))
    try:
        return row_from(read_json(file, LARGEST_CERTIFICATE), name)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError) as error:
        reason = visible(error if isinstance(error, InputError) else f"{type(error).__name__}: {error}", 200)
        raise InputError(f"its certificate.json is damaged ({reason}).") from None


def row_from(certificate: dict, name: str) -> dict:
    """The row of a run with this ``certificate``; a damaged one may raise any error."""
    gap, bounds = certificate["gap"], {}
    for side in ("lower", "upper"):  # the bounds that the gap was taken from
        source = gap[f"{side}_from"]
        bounds[side] = None if source is None else number_or_none(certificate[side][source]["value"])
    gaps = {f"gap_{kind}": number_or_none(gap[kind]) for kind in ("certified", "simulated")}
    return {
        "run": name,
        **{k: printable(certificate[k]) for k in ("problem", "method")},
        **{k: int(number(certificate[k])) for k in ("seed", "step")},
        "train_seconds": number_or_none(certificate["train_seconds"]),
        "perf": performance(certificate),
        **bounds,
        "exact": number_or_none(certificate["exact"]),
        # Older versions wrote negative gaps where the bounds cross: one bound is then wrong, and no gap is ranked.
        **{k: None if value is not None and value < 0.0 else value for k, value in gaps.items()},
        "share": number_or_none(certificate["share"]["certified"]),
        "stopped": printable(certificate.get("stopped", "steps")),
        "warnings": len(list(certificate["warnings"])),
    }


def performance(certificate: dict) -> float | None:
    """The cost of the certified controller; `None` where it is unknown. Older certificates do not name that controller: it is
    then the given one, or the subject of an upper bound, or else the one with the smallest cost, errors included."""
    known = {
        name: e for name, e in certificate["perf"].items() if e is not None and number_or_none(e["value"]) is not None
    }
    spoken_of = [e.get("controller") for e in certificate["upper"].values() if e is not None]
    for name in (certificate.get("controller"), "given", *spoken_of):
        if name in known:
            return number_or_none(known[name]["value"])
    at_most = lambda e: e["value"] + (number_or_none(e.get("bias")) or 0.0) + 2.0 * number(e["se"])
    return number_or_none(min(known.values(), key=at_most)["value"]) if known else None


def number(value) -> float:
    """``value`` of a file as a finite number; `ValueError` or `TypeError` otherwise."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{visible(value, 80)} is not a number")
    return value


def number_or_none(value) -> float | None:
    """`number` of ``value``, or `None` for `None`."""
    return None if value is None else number(value)


def failure_in(folder: Path) -> str:
    """What the log in ``folder`` says a job of a sweep failed by; empty where it says nothing of that."""
    with contextlib.suppress(InputError):
        last = read_text(folder / LOG, LARGEST_LOG).rstrip().rpartition("\n")[2]
        return visible(f"failed: {last[len(FAILED) :]}") if last.startswith(FAILED) else ""
    return ""


def progress_of(folder: Path) -> str:
    """A sentence on how far a run without a certificate came."""
    failed = failure_in(folder)
    try:
        state = newest(folder / "checkpoints")[0]
        total = state["config"]["trainer"]["steps"]
        saved = f"saved at step {int(state['step'])} of {int(total)}; resume={printable(folder)} goes on"
        return f"not finished: {saved}{f'; {failed}' if failed else '.'}"
    except InputError as error:
        return failed or f"not finished: {printable(error)}"
    except (KeyError, TypeError, ValueError):
        return "its checkpoint is not the state of a run."
