"""`report.html` of a run: its results in one page."""

from pathlib import Path

from ocp_torch.errors import InputError, visible
from ocp_torch.files.reading import opened, read_json
from ocp_torch.files.storage import write_atomically
from ocp_torch.problems import Problem
from ocp_torch.runs.report import history, sections
from ocp_torch.runs.report.go_on import going_on
from ocp_torch.runs.report.page import page, paragraph, section, text
from ocp_torch.runs.report.problem import described

REPORT = "report.html"
LARGEST_FIGURE = 2**23  # bytes of a figure that is shown, at most
MOST_FIGURES = 40
PNG = b"\x89PNG\r\n\x1a\n"  # the first bytes of a PNG file
HEADER = 24  # bytes up to the width and height of a PNG file
# Exceptions of a damaged or crafted certificate where it is shown.
DAMAGE = (OSError, ValueError, LookupError, TypeError, AttributeError, OverflowError)


def write_report(folder: Path, problem: Problem, config: dict) -> Path:
    """Write `report.html` of the run in ``folder``, of ``problem`` and its ``config``, from the files there, and return its
    path. Raises `InputError` where they are damaged."""
    certificate = read_json(folder / "certificate.json")
    metrics = read_json(folder / "metrics.json") if (folder / "metrics.json").exists() else None
    try:
        html = report(folder, certificate, metrics, problem, config)
    except DAMAGE as error:
        raise InputError(f"{folder} has no report: {reason(error)}.") from None
    write_atomically(folder / REPORT, lambda path: path.write_text(html, encoding="utf-8"))
    return folder / REPORT


def reason(error: BaseException) -> str:
    """The reason, in words, why a certificate cannot be shown."""
    return visible(
        error if isinstance(error, InputError) else f"its files are damaged ({type(error).__name__}: {error})", 200
    )


def report(folder: Path, certificate: dict, metrics: dict | None, problem: Problem, config: dict) -> str:
    """The page as text."""
    name, method = str(certificate["problem"]), str(certificate["method"])
    seconds, steps = certificate["train_seconds"], certificate["step"]
    told = f"{method}, seed {certificate['seed']}, {steps:,} steps, {seconds:,.0f} s of training. {folder}"
    parts = [
        f"<h1>{text(name)}</h1>",
        paragraph(text(told), "soft"),
        sections.first(certificate),
        section("The problem", *described(problem, config.get("problem") or {})),
        *sections.closed(certificate),
        sections.what_bounds_say(certificate),
        sections.warnings(certificate),
        sections.figures(drawn(folder), problem.dim),
        sections.numbers(metrics),
        sections.learning(history.curves(folder), certificate),
        going_on(folder, problem, config, certificate),
        sections.configuration(config),
    ]
    return page(f"{name}, {method}", parts)


def drawn(folder: Path) -> dict[str, bytes]:
    """The PNG figures in ``folder`` by name, as bytes."""
    found = {}
    for file in sorted((folder / "figures").glob("*.png"))[:MOST_FIGURES]:
        with opened(file, LARGEST_FIGURE) as stream:
            content = stream.read()
        if content.startswith(PNG) and len(content) > HEADER:
            found[file.stem] = content
    return found
