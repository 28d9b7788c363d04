"""From a resolved configuration to a printed reference, a file, and a figure beside those of a run. No Hydra in here."""

import logging
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ocp_torch.control.controller import Controller
from ocp_torch.control.described import problem_name
from ocp_torch.control.saved import controller_file
from ocp_torch.errors import InputError, require_integer, require_section
from ocp_torch.files.reading import FOLDER, kind, require_unlinked
from ocp_torch.files.storage import write_atomically
from ocp_torch.runs.build import build_problem
from ocp_torch.runs.canvas import save_figure
from ocp_torch.runs.evaluate import load_run
from ocp_torch.studies.reference.figure import draw
from ocp_torch.studies.reference.grid import Grid, grid_sides, require_solvable
from ocp_torch.studies.reference.reference import Reference, solve_reference
from ocp_torch.training.settings import MOST_THREADS

log = logging.getLogger(__name__)


class ReferenceJob:
    """A job of the command: a problem, or a run that names one and beside whose controller the reference is drawn. Every
    field is checked before anything is solved or written; raises `InputError` for a wrong one."""

    def __init__(self, config: dict) -> None:
        section = require_section("problem", config["problem"])
        self.controller: Controller | None = None
        if config["run"] is None:
            if not section:
                raise InputError(
                    "problem is missing; give problem=circle, another choice, or run=... with a run's folder."
                )
            self.problem = build_problem(section)
        else:
            # A run names one of the package's problems itself; only a user's own comes from the command line.
            target = str(section.get("_target_", ""))
            if target.startswith("ocp_torch.") and not target.endswith((".Simulator", ".Callable")):
                raise InputError("problem and run are both given, but the run names its problem; leave problem out.")
            self.controller = load_run({"run": config["run"], "problem": section})
            self.problem = self.controller.problem
            folder = controller_file(Path(str(config["run"]))).parent
            require_unlinked(folder, ("figures",))
            self.figure = folder / "figures" / "reference.png"
        self.side, self.memory = config["side"], config["memory"]
        sides = grid_sides(self.problem, self.side, self.memory)
        require_solvable(self.problem, Grid(self.problem.dim, sides[0]))
        self.threads = require_integer("threads", config["threads"], 1, maximum=MOST_THREADS)
        self.file = None if config["save"] is None else _npz(str(config["save"]))

    def run(self) -> Reference:
        """Solve, print, and write the requested files."""
        torch.set_num_threads(self.threads)
        started = time.process_time()
        reference = solve_reference(self.problem, self.side, self.memory)
        log.info("%s\n%.1f s of CPU", reference_table(reference), time.process_time() - started)
        if self.file is not None:
            save_reference(self.file, reference)
            log.info("saved in %s", self.file)
        if self.controller is not None:
            figure = draw(reference, self.controller)
            save_figure(figure, self.figure, "run")
            log.info("drawn in %s", self.figure)
        return reference


def _npz(name: str) -> Path:
    """The NPZ file ``name``, which loads without pickle, if it can be written."""
    path = Path(name)
    if path.suffix != ".npz" or kind(path) == FOLDER:
        raise InputError(f"save is {name!r}, but must be a file whose name ends in .npz.")
    if kind(path.parent) not in (FOLDER, None):
        raise InputError(f"save is {name!r}, but {path.parent} is not a folder.")
    return path


def save_reference(path: Path, reference: Reference) -> None:
    """Write ``optimum``, ``error`` (NaN where it is unknown), ``order``, ``sides``, ``estimates``, and of the finest grid
    ``value`` ``(side,) * d``, ``control`` ``(side,) * d + (m,)`` and with noise the density ``occupation`` ``(side,) * d``,
    at the nodes `k / side`."""
    names = ("optimum", "error", "order", "sides", "estimates", "value", "control")
    arrays: dict[str, Any] = {name: getattr(reference, name) for name in names}
    if reference.error is None:
        arrays["error"] = np.nan
    if reference.occupation is not None:
        arrays["occupation"] = reference.occupation

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_atomically(path, write)


def reference_table(reference: Reference) -> str:
    """The table for the terminal: `OPT` with its error, the grids, the order, and the exact optimum where it is known."""
    problem = reference.problem
    error = "error unknown" if reference.error is None else f"+- {reference.error:.2g}"
    lines = [
        f"{problem_name(problem)}: d = {problem.dim}, m = {problem.control_dim}, rho = {problem.discount:g}, "
        f"q = {problem.exponent:g}",
        f"OPT      {reference.optimum:.9g}  {error}",
    ]
    if problem.exact_optimum is not None:
        off = reference.optimum - problem.exact_optimum
        lines.append(f"exact    {problem.exact_optimum:.9g}  ({off:+.2g} from it)")
    for side, estimate in zip(reference.sides, reference.estimates, strict=True):
        lines.append(f"grid     {estimate:.9g}  {' x '.join([str(side)] * problem.dim)}")
    order = "none (the three grids do not approach evenly)" if math.isnan(reference.order) else f"{reference.order:.2f}"
    change = f"changes by up to {reference.value_change:.2g} from the second grid to the finest"
    lines += [f"order    {order}", f"V        {change}"]
    if reference.occupation is not None:
        lines.append(f"mu*      up to {float(reference.occupation.max()):.5g} at the nodes of the finest grid")
    if reference.error is None:
        lines.append(f"warning: nothing is known of how far the optimum is from this: {reference.unknown}.")
        return "\n".join(lines)
    if not reference.unsettled < 0.5 * reference.error and not reference.unsettled <= 1e-6 * abs(reference.optimum):
        lines.append(
            f"warning: policy iteration stopped before it settled; {reference.unsettled:.2g} of the stated error is for that."
        )
    if not reference.error < 0.01 * abs(reference.optimum):
        lines.append("warning: the stated error is above 1 % of OPT; a larger side lowers it.")
    return "\n".join(lines)
