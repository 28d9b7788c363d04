"""Figures of a run: its certificate on a line; `V`, `u`, `mu` and the HJB slack as curves, or as maps of two coordinates."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ocp_torch.certificate.bounds.bound import LOWER, UPPER
from ocp_torch.certificate.contexts.fields import in_float64
from ocp_torch.certificate.lower.slack import slack_function
from ocp_torch.certificate.settings import LONGEST_NAME
from ocp_torch.control.policies import NETWORK, occupation_density, trained_policies
from ocp_torch.errors import visible
from ocp_torch.fields import Fields
from ocp_torch.maths.brownian import Grid, discounted, increments, path_integral
from ocp_torch.maths.runge_kutta import rate_at
from ocp_torch.maths.seeds import Branch, derive_seed
from ocp_torch.maths.supremum import batched
from ocp_torch.problems import Problem
from ocp_torch.problems.constants import Constants
from ocp_torch.problems.starts import initial_points
from ocp_torch.runs.canvas import Figure, blank_figure
from ocp_torch.runs.frame import Frame, frame_of, in_units

LINE_POINTS = 400  # of a curve
MAP_POINTS = 80  # of a map, along each coordinate
BINS = {1: 50, 2: 20}  # dimension -> bins a coordinate of the simulated occupation density
STARTS = 2048  # of its trajectories
FIGURE_STEPS = 16  # of each trajectory
TITLES = {
    "value": "V",
    "control_value": "u from V",
    "control_density": "u = w / mu",
    "control_trajectories": "u from V of trajectories",
    "control_subsolution": "u from V trained on",
    "occupation": "mu",
    "slack": "HJB slack Q",
}
Function = Callable[[Tensor], Any]


def interval_figure(certificate: dict) -> Figure:
    """The certificate (as a dict of its schema) on a line: bounds that count, `OPT` where known, and performances, with
    their intervals.

    Values much farther from the tightest ones than these are from one another are cut off, with an arrow and the value.
    """
    counting = lambda side: [(n, e) for n, e in certificate[side].items() if e and e.get("counts", True)]
    rows = [(f"{n} ≤ OPT", e, "C0") for n, e in counting(LOWER)]
    rows += [(f"Perf, {n}", e, "C2") for n, e in certificate["perf"].items() if e]
    rows += [(f"{n} ≤ Perf", e, "C4") for n, e in certificate.get("perf_lower", {}).items() if e]
    rows += [(f"≤ {n}", e, "C3") for n, e in counting(UPPER)]
    rows += [("doing nothing", e, "C7") for e in certificate["baseline"].values() if e]
    figure = blank_figure(7.0, 1.2 + 0.32 * max(len(rows), 1))
    axis = figure.subplots()
    lows, highs = ([e["value"] for _, e in counting(side)] for side in (LOWER, "perf"))
    highs = highs or [e["value"] for _, e in counting(UPPER)]
    ends = ([max(lows)] if lows else []) + ([min(highs)] if highs else [])
    ends += [certificate["exact"]] if certificate["exact"] is not None else []
    ends += [end for name, e, _ in rows if name.startswith("Perf") for end in e["interval"]]
    left, right = min(ends, default=0.0), max(ends, default=1.0)
    room = max(2.0 * (right - left), 1e-3 * max(abs(left), abs(right)), 1e-12)
    left, right = left - room, right + room
    axis.set_xlim(left, right)
    for y, (_, e, color) in enumerate(rows):
        outside = min(max(e["value"], left), right)
        if outside != e["value"]:
            marker, side, at = ("<", 1, "left") if outside == left else (">", -1, "right")
            axis.plot(outside, y, marker, color=color, clip_on=False)
            offset: dict[str, Any] = {"xytext": (8 * side, 0), "textcoords": "offset points"}
            axis.annotate(f"{e['value']:.5g}", (outside, y), va="center", ha=at, **offset)
            continue
        axis.errorbar(e["value"], y, xerr=0.5 * (e["interval"][1] - e["interval"][0]), fmt="o", capsize=3, color=color)
    if certificate["exact"] is not None:
        axis.axvline(certificate["exact"], color="k", linestyle=":", label="OPT")
        axis.legend(loc="upper right")
    # A name may come from a file, and must not be read as a formula.
    axis.set_yticks(range(len(rows)), [visible(name, LONGEST_NAME) for name, *_ in rows], parse_math=False)
    axis.invert_yaxis()
    title = f"{visible(certificate['problem'], LONGEST_NAME)}, {100 * certificate['confidence']:.4g} % intervals"
    axis.set_title(title, parse_math=False)
    return figure


@dataclass(frozen=True)
class FieldFigures:
    """Figures of trained ``fields``, whose `mu` follows by ``occupation`` (see `trained_policies`).

    The simulated density is that of the controller ``kind``, by default the first; so is the learned one if it was ``fitted``
    to that controller. With ``quick`` slack and simulation are left out.
    """

    problem: Problem
    fields: Fields
    constants: Constants
    occupation: str | None
    kind: str | None = None
    fitted: Function | None = None
    quick: bool = False

    def figures(self) -> dict[str, Figure]:
        """A figure for each quantity; in three and more dimensions a cut along the first two coordinates through 1/2, or in
        physical units through the middle of the others."""
        dim, frame = self.problem.dim, frame_of(self.problem)
        x = frame.line(LINE_POINTS) if dim == 1 else frame.map(MAP_POINTS)
        figures = {}
        for name, functions in self.quantities().items():
            values = {label: _columns(function, x) for label, function in functions.items()}
            unit = frame.control if name.startswith("control") else ""
            title = f"{TITLES[name]}, {unit}" if unit else TITLES[name]
            known = {label: v for label, v in values.items() if v is not None}
            figures[name] = (_curve if dim == 1 else _map)(title, x, known, frame)
        return figures

    def quantities(self) -> dict[str, dict]:
        """Name -> the learned, the exact and the simulated function, or `None`."""
        problem, fields, how = self.problem, in_float64(self.fields), self.occupation
        policies = trained_policies(how, problem, fields, self.constants)
        drawn: dict[str, dict] = {}
        if fields.value is not None:
            drawn["value"] = {"learned": fields.value, "exact": problem.exact_value}
            if problem.has_simulator and not self.quick:
                drawn["slack"] = {"learned": slack_function(problem, fields.value)}
        for kind, policy in policies.items():
            if kind != "value" or problem.knows_control_matrix:
                functions = {"learned": policy, "exact": problem.exact_control}
                drawn[f"control_{kind}"] = {label: in_units(problem, control) for label, control in functions.items()}
        learned, simulated = self.fitted, None
        if learned is None and how is not None and (problem.has_simulator or how == NETWORK):
            learned = occupation_density(how, problem, fields, self.constants)
        if problem.dim in BINS and problem.has_simulator and not self.quick:
            quick = trained_policies(how, problem, fields.rounded, self.constants)  # as exact as a histogram can show
            simulated = simulated_occupation(problem, quick.get(self.kind or "") or next(iter(quick.values())))
        if learned is not None or simulated is not None:
            drawn["occupation"] = {"learned": learned, "exact": problem.exact_occupation, "simulated": simulated}
        return drawn


@torch.no_grad()
def simulated_occupation(problem: Problem, policy: Function) -> Function:
    """A histogram of `mu^u`, for one or two coordinates: the states of the closed loop of ``policy`` at times `T ~ Exp(rho)`,
    from starts weighted by `mu0`, few enough for a fraction of a second."""
    bins = BINS[problem.dim]
    points, start_mass = initial_points(problem, STARTS, 0, derive_seed(0, Branch.FIGURES), extra=1)
    x0, times = points[:, :-1], -torch.log1p(-points[:, -1]) / problem.discount
    moving = lambda x: (problem.velocity(x, policy(x)), x[:, 0])
    sigma, rho = problem.noise(x0), problem.discount
    if sigma is None:
        _, end = rate_at(moving, x0, rho, times, FIGURE_STEPS)
    else:
        grid = Grid(times, FIGURE_STEPS, 1.0)
        moves = increments(grid, sigma.shape[-1], 0, 0, 0)
        end = path_integral(moving, problem.noise, x0, grid, moves, discounted(rho))[1].remainder(1.0)
    cell = lambda x: ((x * bins).long().clamp(0, bins - 1) * bins ** torch.arange(problem.dim)).sum(dim=-1)
    mass = torch.zeros(bins**problem.dim, dtype=torch.float64)
    mass.index_add_(0, cell(end), start_mass)
    density = mass * bins**problem.dim / STARTS
    return lambda x: density[cell(x.remainder(1.0))]


@torch.no_grad()
def _columns(function: Function | None, x: Tensor) -> Tensor | None:
    """The values of ``function`` at ``x`` as columns ``(N, k)``, with infinite ones as gaps (NaN); `None` without any."""
    if function is None or function(x[:1]) is None:
        return None
    values = batched(function, x).reshape(len(x), -1)
    return values.where(torch.isfinite(values), torch.nan)


def _curve(title: str, x: Tensor, values: dict[str, Tensor], frame: Frame) -> Figure:
    figure = blank_figure(5.2, 4.0)
    axis = figure.subplots()
    for label, form in (("simulated", "C7"), ("learned", "C0"), ("exact", "k:")):
        if label in values:
            axis.plot(frame.places(x), values[label], form, label=label)
    if len(axis.lines) > 1:
        axis.legend()
    axis.set_title(title, parse_math=False)  # a recording may have named the control
    axis.set_xlabel(frame.labels[0], parse_math=frame.symbols)
    return figure


def _map(title: str, x: Tensor, panels: dict[str, Tensor], frame: Frame) -> Figure:
    stride = MAP_POINTS // 16
    some = lambda t: t[:, :2].reshape(MAP_POINTS, MAP_POINTS, 2)[::stride, ::stride].transpose(0, 1).unbind(-1)
    # A control of several components is drawn as its size, with arrows for its first two.
    sizes = {label: v.norm(dim=-1) if v.shape[1] > 1 else v[:, 0] for label, v in panels.items()}
    low = min(float(s.nan_to_num(nan=torch.inf).min()) for s in sizes.values())
    high = max(float(s.nan_to_num(nan=-torch.inf).max()) for s in sizes.values())
    figure = blank_figure(5.2 * len(panels), 4.0)
    for axis, (label, values) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True):
        grid = sizes[label].reshape(MAP_POINTS, MAP_POINTS).T
        image = axis.imshow(grid, origin="lower", extent=frame.extent, aspect=frame.aspect, vmin=low, vmax=high)
        if values.shape[1] > 1:
            axis.quiver(*some(frame.places(x)), *some(values), color="w")
        name = f"|{title}|" if values.shape[1] > 1 else title
        axis.set_title(name if label == "learned" else f"{name}, {label}", parse_math=False)
        axis.set_xlabel(frame.labels[0], parse_math=frame.symbols)
        axis.set_ylabel(frame.labels[1], parse_math=frame.symbols)
        figure.colorbar(image, ax=axis)
    return figure
