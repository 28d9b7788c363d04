"""The sections of the report of a run."""

import yaml

from ocp_torch.certificate.bounds import BOUNDS as LISTED
from ocp_torch.errors import MOST_NOTES
from ocp_torch.runs.report import history, words
from ocp_torch.runs.report.advice import advice
from ocp_torch.runs.report.bracket import bracket
from ocp_torch.runs.report.charts import chart
from ocp_torch.runs.report.lead import certified, lead
from ocp_torch.runs.report.page import code, folded, image, listing, paragraph, prose, section, table, text
from ocp_torch.runs.report.problem import BRACKET

# Beginning of the name of a figure -> what it shows, in the order of the page; other figures follow.
FIGURES = {
    "motion": "The controller at work.",
    "value": "V: what it costs from each state on.",
    "control_": "u: what the controller does.",
    "occupation": "mu: where the discounted time is spent.",
    "slack": "The slack Q of the Hamilton-Jacobi-Bellman equation: the bounds pay for where it is above 0.",
}
# This figure is left out: the page draws the bracket itself.
DRAWN = "certificate"
# Entry of the metrics -> name of its row.
ROWS = {"controller": "this controller", "zero": "no control", "classical": "a classical controller"}


def first(certificate: dict) -> str:
    """The first sentence: how far from optimal the controller can be."""
    return paragraph(text(lead(certificate)), "lead" if certified(certificate) else "lead alert")


def closed(certificate: dict) -> list[str]:
    """The sections with the bracket, and with which of its numbers to trust."""
    note = "Filled dots count, open ones would if a guess were right; the band, simulation included, is where OPT lies."
    drawn = [paragraph(BRACKET, "formula"), bracket(certificate), paragraph(note, "soft")]
    trusted = (paragraph(prose(said)) for said in words.trust(certificate))
    return [section("The bracket", *drawn), section("Which number to trust", *trusted)]


def what_bounds_say(certificate: dict) -> str:
    """The table of every number with its error and assumptions, and the meaning of these words."""
    exact, rows = certificate["exact"], list[list[str]]()
    needs, bases = dict[str, None](), dict[str, None]()
    level = f"± {words.percent(certificate['confidence'])}"
    for side in ("lower", "perf", "upper", "perf_lower", "baseline"):
        for name, e in certificate.get(side, {}).items():
            if not e:
                continue
            rests = {str(need): str(basis) for need, basis in e.get("rests_on", {}).items()}
            needs |= dict.fromkeys(rests)
            bases |= dict.fromkeys(rests.values())
            value = words.number(e["value"])
            against = words.percent(value / exact - 1.0) if exact else ""
            counts = "yes" if e.get("counts", True) else f"if {e['if']}" if "if" in e else "no"
            on = ", ".join(f"{need} ({basis})" for need, basis in rests.items()) or _otherwise(side, name)
            named = "doing nothing" if side == "baseline" else words.label(side, name)
            shown = [named, f"{value:.8g}", f"{e['interval'][1] - value:.1e}", against, counts, on]
            rows.append([text(cell) for cell in shown])
    if not rows:
        return ""
    header = ["", "value", level, "vs OPT" if exact else "", "counts", "rests on"]
    listed = {name for side in ("lower", "upper") for name, e in certificate[side].items() if e}
    own = {bound.name: (type(bound).__doc__ or "").split("\n")[0] for bound in LISTED}
    said = [(text(n), prose(words.BOUNDS.get(n) or own.get(n, ""))) for n in words.BOUNDS | own if n in listed]
    said += [(text(need), prose(words.NEEDS.get(need, ""))) for need in needs]
    said += [(text(basis), prose(words.BASES.get(basis, ""))) for basis in bases]
    meant = folded("What these words mean", listing((term, meaning) for term, meaning in said if meaning))
    return section("Every number, and what it rests on", table(header, rows, (1, 2, 3)), meant)


def _otherwise(side: str, name: str) -> str:
    return "simulation" if side in ("perf", "baseline") else "the mathematics alone" if name == "rigorous" else ""


def learning(found: history.Curves, certificate: dict) -> str:
    """Charts of bounds, gaps, losses and violations along the steps."""
    group = lambda name: history.group(found, name)
    perf = {n: points for n, points in group("performance").items() if n == certificate.get("controller")}
    bounds, lower, best = group("bounds"), certificate["lower"], certificate["gap"]["lower_from"]
    # The axis covers the two sides of the gap in the second half of the quick evaluations: at first bounds are anywhere.
    held = [bounds[name] for name in ([best] if best else lower) if name in bounds] + list(perf.values())
    tight = [y for points in held for _, y in points[(len(points) - 1) // 2 :]]
    curves = {words.label("lower", name): bounds.pop(name) for name in lower if name in bounds}
    curves |= {words.label("perf", name): points for name, points in perf.items()}
    curves |= {"OPT": bounds.pop("exact")} if "exact" in bounds else {}
    curves |= {words.label("upper", name): bounds[name] for name in reversed(bounds)}
    running = group("running")
    shown = (running.get(name, []) for name in ("F_M", "OPT", "Perf"))
    late = [y for points in shown for _, y in points[len(points) // 2 :]]
    charts = {
        "The bracket closes: running estimates": chart(running, span=late),
        "The bracket closes: quick evaluations": chart(curves, span=tight),
        "Gap": chart(group("gap"), log=True),
        "Losses": chart(group("loss")),
        "Violations": chart(group("violation"), log=True),
    }
    return section("Learning curves", *(f"<h3>{name}</h3>{drawn}" for name, drawn in charts.items() if drawn))


def figures(drawn: dict[str, bytes], dim: int) -> str:
    """The section of the figures ``drawn``, PNG bytes by name, of a problem in ``dim`` dimensions."""
    known = [(k, name) for name in drawn if name != DRAWN for k, start in enumerate(FIGURES) if name.startswith(start)]
    first = [(name, list(FIGURES.values())[k]) for k, name in sorted(known)]
    rest = [(name, name) for name in sorted(drawn) if name != DRAWN and name not in dict(first)]
    shown = [image(drawn[name], caption) for name, caption in [*first, *rest]]
    cut = "Maps are cuts along the first two coordinates, through the middle of the others." if dim > 2 else ""
    inner = f'<div class="figures">{"".join(shown)}</div>'
    return section("V, u, mu and motion", paragraph(cut, "soft") if cut else "", inner) if shown else ""


def numbers(metrics: dict | None) -> str:
    """The table of the controller's metrics beside those of no control and a classical controller."""
    rows = {name: metrics[name] for name in ROWS if name in metrics} if metrics else {}
    if not rows or metrics is None:
        return ""
    names = list(rows["controller"])
    cells = [[text(ROWS[row]), *(text(f"{of[name]:.4g}") for name in names)] for row, of in rows.items()]
    told = f"Means over {metrics['starts']:,} random starts, simulated for {metrics['duration']:g} units of time."
    columns = ["", *(name.replace("_", " ") for name in names)]
    return section(
        "Beside other controllers", table(columns, cells, range(1, len(columns))), paragraph(text(told), "soft")
    )


def warnings(certificate: dict) -> str:
    """The section of warnings, each once, with what to do about it."""
    told = dict.fromkeys(str(w) for w in certificate["warnings"][:MOST_NOTES])
    shown = [(text(words.sentence(w)), f"What to do: {prose(advice(w))}") for w in told]
    return section("Warnings", listing(shown, "warnings")) if told else ""


def configuration(config: dict) -> str:
    return section(
        "Configuration", folded("all fields", code(yaml.safe_dump(config, sort_keys=False, allow_unicode=True)))
    )
