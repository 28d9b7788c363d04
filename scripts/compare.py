"""Runs side by side: python scripts/compare.py outputs/circle_pd outputs/sweeps/... [csv=FILE] [plot=FILE.png]"""

from __future__ import annotations

import sys
from pathlib import Path

from ocp_torch.cli.outcome import fail
from ocp_torch.errors import InputError, nearest, shown
from ocp_torch.files.reading import kind
from ocp_torch.runs.compare import compare


def main(arguments: list[str]) -> None:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(__doc__)
        return
    options = dict(a.split("=", 1) for a in arguments if "=" in a and kind(a) is None)
    for name, value in options.items():
        if name not in ("csv", "plot"):
            raise InputError(
                f"{name} is not an option{nearest(name, ('csv', 'plot'))}; it takes csv=FILE and plot=FILE."
            )
        if not value:
            raise InputError(f"{name} is empty, but must be the file to write.")
    runs = [a for a in arguments if "=" not in a or kind(a) is not None]
    for run in runs:
        if kind(run) is None:
            raise InputError(f"{shown(run)} does not exist; give runs' folders, or folders that hold some.")
    comparison = compare([Path(run) for run in runs])
    print(comparison.table())
    for name, save in (("csv", comparison.save_csv), ("plot", comparison.save_plot)):
        if name in options:
            save(Path(options[name]))


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        fail(str(error))
