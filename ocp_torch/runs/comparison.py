"""Runs side by side: as a table for the terminal, as CSV, and as a plot."""

import csv
from dataclasses import dataclass
from pathlib import Path

from ocp_torch.errors import InputError
from ocp_torch.files.storage import write_atomically
from ocp_torch.runs.canvas import blank_figure

# A number that would take more characters is shown by its leading digits and its size.
WIDEST = 24
# Column -> how a number in it is shown.
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
    """``rows`` have the columns `COLUMNS`, `None` where a number does not apply; ``unfinished`` says, per run, why it has
    none."""

    rows: list[dict]
    unfinished: dict[str, str]

    def table(self) -> str:
        """For the terminal."""
        cells = [list(COLUMNS), *([_shown(row[c], form) for c, form in COLUMNS.items()] for row in self.rows)]
        widths = [max(len(line[k]) for line in cells) for k in range(len(COLUMNS))]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in cells]
        lines.insert(1, "-" * max(map(len, lines)))
        lines += [f"not in the table: {run}: {why}" for run, why in self.unfinished.items()]
        return "\n".join(lines)

    def save_csv(self, file: Path) -> None:
        """Numbers in full precision, empty where they do not apply."""

        def write(temporary: Path) -> None:
            with temporary.open("w", newline="") as stream:
                writer = csv.DictWriter(stream, COLUMNS)
                writer.writeheader()
                writer.writerows(self.rows)

        write_atomically(file, write)

    def save_plot(self, file: Path) -> None:
        """What lies between the lower bound and each upper side of every run, as a picture."""
        if file.suffix.lower() not in (".png", ".pdf", ".svg"):
            raise InputError(f"plot is {str(file)!r}, but must end in .png, .pdf or .svg.")
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
        write_atomically(file, lambda path: figure.savefig(path, format=file.suffix.lower()[1:], dpi=120))


def _shown(value, form: str) -> str:
    text = "-" if value is None else format(value, form)
    return text if len(text) <= WIDEST or not isinstance(value, int | float) else f"{value:.6g}"
