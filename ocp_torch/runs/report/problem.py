"""The description of a problem in words and formulas."""

import contextlib
import inspect
import sys

from ocp_torch.problems import Problem
from ocp_torch.problems.commands import PACKAGE, as_typed
from ocp_torch.runs.report.page import listing, paragraph, prose, text

COST = (
    "minimise &nbsp; ρ E ∫<sub>0</sub><sup>∞</sup> e<sup>−ρt</sup> "
    "( f(x<sub>t</sub>) + |u<sub>t</sub>|<sup>q</sup> / q ) dt"
)
MOTION = (
    "dx = ( a(x) + B(x) u ) dt{noise}, &nbsp; x<sub>0</sub> ~ μ<sub>0</sub>, &nbsp; x on the torus [0, 1)<sup>{d}</sup>"
)
BRACKET = "F<sub>M</sub>(V) ≤ OPT ≤ Perf(u) ≤ J(w, μ)"


def described(problem: Problem, section: dict) -> list[str]:
    """``problem`` as HTML; ``section`` is the part of the configuration that made it."""
    cls = type(problem)
    ours = cls.__module__.startswith(f"{PACKAGE}.")
    module = sys.modules.get(cls.__module__)
    told = [module.__doc__ if ours and module else None, cls.__doc__]
    told = list(dict.fromkeys(_first_paragraph(doc) for doc in told if doc))
    noise = " + σ(x) dW" if _noisy(problem) else ""
    d, m = problem.dim, problem.control_dim
    rows = [
        ("f, a, B", "state cost, motion without control, and what the controls do: known through samples alone"),
        ("μ<sub>0</sub>", "density of the initial state"),
        ("d, m", f"{d} {'state' if d == 1 else 'states'}, {m} {'control' if m == 1 else 'controls'}"),
        (
            "ρ, q",
            f"discount {problem.discount:g} per unit of time, so that what is {3.0 / problem.discount:.3g} "
            f"away weighs e<sup>−3</sup>; exponent {problem.exponent:g}",
        ),
    ]
    if problem.control_limit is not None:
        each = isinstance(problem.control_limit, list | tuple)
        limit = text(problem.control_limit, 200)
        rows.append(("limit", f"each |u<sub>i</sub>| within {limit}" if each else f"|u| ≤ {limit}"))
    if problem.measures is not None:
        coordinates, controls = problem.measures.coordinates, problem.measures.controls
        rows.append(("states", "; ".join(text(_range(c)) for c in coordinates)))
        rows.append(("controls", ", ".join(text(c.label) for c in controls)))
    arguments = [f"{name} = {as_typed(value)}" for name, value in section.items() if name != "_target_"]
    rows += [("made with", text(", ".join(arguments)))] if arguments else []
    formula = f"{COST}<br>{MOTION.format(noise=noise, d=d)}"
    return [*(paragraph(prose(doc)) for doc in told), paragraph(formula, "formula"), listing(rows)]


def _first_paragraph(doc: str) -> str:
    return inspect.cleandoc(doc).split("\n\n")[0]


def _noisy(problem: Problem) -> bool:
    with contextlib.suppress(Exception, SystemExit):  # a user's code, which may have ended the run
        return problem.noisy
    return True


def _range(coordinate) -> str:
    if hasattr(coordinate, "high"):
        return f"{coordinate.label} from {coordinate.low:g} to {coordinate.high:g}"
    return f"{coordinate.label}, of period {coordinate.length:.6g}"
