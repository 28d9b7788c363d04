"""Receding horizons: a short one with `V` at its end against a long one without, by cost from the same starts and by time."""

import logging
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ocp_torch.control.receding_horizon import RecedingHorizon
from ocp_torch.errors import InputError, require_integer, require_number
from ocp_torch.export.casadi_function import require_casadi
from ocp_torch.maths.runge_kutta import discounted_integral
from ocp_torch.problems import Problem
from ocp_torch.problems.idle_noise import idle_noise
from ocp_torch.problems.starts import drawn_starts
from ocp_torch.runs.evaluate import load_run

log = logging.getLogger(__name__)

STEP = 0.05  # default time for which a control is held, in units of 1 / rho
TIME = 6.0  # default time that the closed loop is followed, in units of 1 / rho
SUBSTEPS = 5  # steps of the integration while a control is held
MOST = 10_000  # controls, at most


Control = Callable[[np.ndarray], np.ndarray]  # of one state


@dataclass(frozen=True)
class Played:
    """The costs of a controller from each start ``(n,)``, and the seconds it took for a control."""

    costs: np.ndarray
    seconds: float


def play(problem: Problem, control: Control, x0: np.ndarray, step: float, steps: int) -> Played:
    """Play ``control``, asked ``steps`` times and held for ``step`` each time, from each of ``x0`` ``(n, d)``."""
    costs, spent = [], 0.0
    for start in torch.as_tensor(x0):
        if isinstance(control, RecedingHorizon):
            control.reset()
        x, total = start.unsqueeze(0), 0.0
        for k in range(steps):
            began = time.perf_counter()
            u = torch.as_tensor(control(x[0].numpy())).unsqueeze(0)
            spent += time.perf_counter() - began
            held = lambda y, u=u: problem.motion(y, u)
            part, x = discounted_integral(held, x, problem.discount, step, SUBSTEPS, wrap=False)
            total += math.exp(-problem.discount * k * step) * float(part)
        costs.append(total)
    return Played(np.array(costs), spent / (len(x0) * steps))


def horizons(config: dict) -> Callable[[], dict[str, Played]]:
    """A function that plays a saved controller, a receding horizon with its `V` at the end, and one ``longer`` times as long
    without. Checks ``config`` first: `InputError` for a wrong field, and for a run without a `V`."""
    controller, casadi = load_run(config), require_casadi()
    problem = controller.problem
    if controller.fields.value is None:
        raise InputError(f"run is {str(config['run'])!r}, which holds no V: take one of method=dual or pd.")
    if not problem.has_simulator or problem.noisy:
        idle = idle_noise(problem)
        hint = f" ({idle})" if idle else ""
        raise InputError(f"a receding horizon needs a problem that can be simulated, without noise{hint}.")
    sizes = {name: require_integer(name, config[name], 1, maximum=MOST) for name in ("steps", "longer", "starts")}
    longest = 1.0 / problem.discount  # a few steps of the integration can follow the system for no longer
    step = STEP * longest if config["step"] is None else config["step"]
    step = require_number("step", step, above=0.0, at_most=longest)
    lasts = TIME * longest if config["time"] is None else config["time"]
    lasts = require_number("time", lasts, above=0.0, at_most=MOST * step)
    seed = require_integer("seed", config["seed"], 0)
    count = max(1, round(lasts / step))

    def compare() -> dict[str, Played]:
        with tempfile.TemporaryDirectory() as folder:
            (file,) = controller.export(Path(folder) / "V.casadi", coordinates="torus")
            V = casadi.Function.load(str(file))
        x0 = drawn_starts(problem, sizes["starts"], seed).numpy()
        with_V = RecedingHorizon(problem, sizes["steps"], step, V)
        alone = RecedingHorizon(problem, sizes["steps"] * sizes["longer"], step)
        log.info("%d starts, %g units of time, a control every %g", len(x0), count * step, step)
        found = {"the controller": play(problem, lambda x: controller(x[None]).astype(np.float64)[0], x0, step, count)}
        for horizon, end in ((with_V, "V"), (alone, "nothing")):
            name = f"a horizon of {horizon.steps * horizon.step:g}, {end} at its end"
            found[name] = play(problem, horizon, x0, step, count)
            if horizon.failed:
                log.warning(
                    "warning: %s: IPOPT did not converge at %d of %d states.", name, horizon.failed, len(x0) * count
                )
        log.info("%s", table(found))
        return found

    return compare


def table(found: dict[str, Played]) -> str:
    """A table of mean costs, their excess over the last one with its standard error, and milliseconds a control."""
    *_, last = found.values()
    width = max(map(len, found))
    lines = [f"{'':{width}}  {'cost':>10}  {'over the last, %':>18}  {'ms':>8}"]
    for name, played in found.items():
        apart = 100.0 * (played.costs - last.costs) / last.costs.mean()
        error = apart.std(ddof=1) / math.sqrt(len(apart)) if len(apart) > 1 else math.nan
        difference = f"{apart.mean():.2f} +- {error:.2f}"
        lines.append(f"{name:{width}}  {played.costs.mean():10.5f}  {difference:>18}  {1e3 * played.seconds:8.2f}")
    return "\n".join(lines)
