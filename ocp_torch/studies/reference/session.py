"""From a resolved configuration to a printed reference, a file, and a figure beside those of a run. No Hydra in here."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass
from pathlib import Path

import torch

from ocp_torch.control.controller import Controller, problem_name
from ocp_torch.errors import InputError, require_integer, require_section
from ocp_torch.files.reading import require_unlinked
from ocp_torch.problems import Problem
from ocp_torch.runs.build import build_problem
from ocp_torch.runs.evaluate import load_run
from ocp_torch.studies.reference.checks import grid_sides, require_solvable
from ocp_torch.studies.reference.figure import draw, save_figure
from ocp_torch.studies.reference.files import require_npz, save_reference
from ocp_torch.studies.reference.grid import Grid
from ocp_torch.studies.reference.reference import Reference, solve_reference
from ocp_torch.training.settings import MOST_THREADS

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReferenceJob:
    """What was asked for, checked. ``controller`` is that of the run to draw beside, if any."""

    problem: Problem
    controller: Controller | None
    figure: Path | None
    side: int | None
    memory: float
    threads: int
    file: Path | None

    def run(self) -> Reference:
        """Solve, print, and write what was asked for."""
        torch.set_num_threads(self.threads)
        started = time.process_time()
        reference = solve_reference(self.problem, self.side, self.memory)
        log.info("%s\n%.1f s of CPU", reference_table(reference), time.process_time() - started)
        if self.file is not None:
            save_reference(self.file, reference)
            log.info("saved in %s", self.file)
        if self.figure is not None:
            save_figure(self.figure, draw(reference, self.controller))
            log.info("drawn in %s", self.figure)
        return reference


def reference_job(config: dict) -> ReferenceJob:
    """Check every field before anything is solved or written. Raises `InputError` for a wrong one."""
    controller, figure, section = None, None, require_section("problem", config["problem"])
    if config["run"] is None:
        if not section:
            raise InputError("problem is missing; give problem=circle, another choice, or run=... with a run's folder.")
        problem = build_problem(section)
    else:
        # A run names one of the package's problems itself; only a user's own comes from the command line.
        target = str(section.get("_target_", ""))
        if target.startswith("ocp_torch.") and not target.endswith((".Simulator", ".Callable")):
            raise InputError("problem and run are both given, but the run names its problem; leave problem out.")
        controller = load_run({"run": config["run"], "problem": section})
        problem, path = controller.problem, Path(str(config["run"]))
        folder = path if path.is_dir() else path.parent
        require_unlinked(folder, ("figures",))
        figure = folder / "figures" / "reference.png"
    sides = grid_sides(problem.dim, config["side"], config["memory"])
    require_solvable(problem, Grid(problem.dim, sides[0]))
    threads = require_integer("threads", config["threads"], 1, maximum=MOST_THREADS)
    file = None if config["save"] is None else require_npz("save", config["save"])
    return ReferenceJob(problem, controller, figure, config["side"], config["memory"], threads, file)


def reference_table(reference: Reference) -> str:
    """What a user reads: `OPT` with its error, the grids, the order, and the exact optimum where the problem knows it."""
    problem = reference.problem
    lines = [
        f"{problem_name(problem)}: d = {problem.dim}, m = {problem.control_dim}, rho = {problem.discount:g}, "
        f"q = {problem.exponent:g}",
        f"OPT      {reference.optimum:.9g}  "
        + ("error unknown" if reference.error is None else f"+- {reference.error:.2g}"),
    ]
    if problem.exact_optimum is not None:
        off = reference.optimum - problem.exact_optimum
        lines.append(f"exact    {problem.exact_optimum:.9g}  ({off:+.2g} from it)")
    for side, estimate in zip(reference.sides, reference.estimates, strict=True):
        lines.append(f"grid     {estimate:.9g}  {' x '.join([str(side)] * problem.dim)}")
    order = "none (the three grids do not approach evenly)" if math.isnan(reference.order) else f"{reference.order:.2f}"
    lines.append(f"order    {order}")
    lines.append(f"V        changes by up to {reference.value_change:.2g} from the second grid to the finest")
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
