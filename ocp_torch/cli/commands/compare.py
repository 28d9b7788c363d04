"""Runs side by side: scripts/compare.py or ocp-compare, outputs/circle_pd outputs/sweeps/... [csv=FILE] [plot=FILE.png]

The page html=FILE.html has table, gaps and what each run says, and links to the runs' own reports. With
against=problem.noise (or any other number of the configuration) the plot shows gaps against that."""

import sys
from pathlib import Path

from ocp_torch.cli.outcome import fail, show
from ocp_torch.errors import InputError, nearest, shown
from ocp_torch.files.reading import kind
from ocp_torch.runs.compare import compare
from ocp_torch.runs.report.many import save_page
from ocp_torch.runs.trend import save_trend

OPTIONS = ("csv", "plot", "html", "against")


def compared(arguments: list[str]) -> None:
    """Print, and write, what ``arguments`` ask for. Raises `InputError`."""
    if not arguments or arguments[0] in ("-h", "--help"):
        return show(str(__doc__))
    options = dict(a.split("=", 1) for a in arguments if "=" in a and kind(a) is None)
    options = {name: value.strip("'\"") for name, value in options.items()}  # quoted, as other commands want it
    for name, value in options.items():
        if name not in OPTIONS:
            told = f"{name} is not an option{nearest(name, OPTIONS)}"
            raise InputError(f"{told}; it takes csv=FILE, plot=FILE, html=FILE and, with a plot, against=FIELD.")
        if not value:
            raise InputError(f"{name} is empty, but must be the file to write, or a field to plot against.")
    if "against" in options and "plot" not in options:
        raise InputError("against says what a plot is against, but there is no plot=FILE.")
    runs = [a for a in arguments if "=" not in a or kind(a) is not None]
    for run in runs:
        if kind(run) is None:
            raise InputError(f"{shown(run)} does not exist; give runs' folders, or folders that hold some.")
    comparison = compare([Path(run) for run in runs])
    show(comparison.table())
    if "csv" in options:
        comparison.save_csv(Path(options["csv"]))
    if "html" in options:
        save_page(comparison, Path(options["html"]))
    if "against" in options:
        save_trend(comparison, options["against"], Path(options["plot"]))
    elif "plot" in options:
        comparison.save_plot(Path(options["plot"]))
    for name in ("csv", "html", "plot"):
        if name in options:
            show(f"wrote {options[name]}")


def main() -> None:
    try:
        compared(sys.argv[1:])
    except InputError as error:
        fail(str(error))
