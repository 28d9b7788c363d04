"""Benchmarks of several problems beside each other: files of curves, and pictures of several of them."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median

import numpy as np

from ocp_torch import __version__
from ocp_torch.errors import InputError, require_integer, require_number, require_section
from ocp_torch.files.reading import FILE, FOLDER, kind, read_json
from ocp_torch.files.storage import finite, write_atomically
from ocp_torch.runs.canvas import blank_figure
from ocp_torch.studies.benchmark.measure import Curve, Point
from ocp_torch.studies.benchmark.report import by_contender, contest_table, draw, plot, reference

CURVES = "curves.json"
# Packages whose version is saved, as numbers may depend on it.
PACKAGES = ("torch", "stable_baselines3")
# Dimensions needed for an exponent of the cost: two points always lie on a line.
FEWEST = 3


@dataclass(frozen=True)
class Family:
    """The curves of one problem, which ``fields`` describe; ``exact`` is its `OPT`, `None` where it is unknown, ``versions``
    are those of the packages that ran."""

    problem: str
    dim: int
    fields: dict
    exact: float | None
    curves: list[Curve]
    versions: dict[str, str]

    @property
    def kind(self) -> str:
        """The problem apart from its dimension."""
        return f"{self.problem} {json.dumps({k: v for k, v in self.fields.items() if k != 'dim'}, sort_keys=True)}"

    @property
    def optimum(self) -> float:
        """`OPT`, or the best lower bound found."""
        return reference(self.curves, self.exact)[0]

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(finite(asdict(self)), indent=1) + "\n"
        write_atomically(folder / CURVES, lambda path: path.write_text(text))

    @classmethod
    def read(cls, path: Path) -> "Family":
        """The family in a file of `write`. Raises `InputError` for any other file."""
        data = read_json(path)
        try:
            curves = [Curve(**{**c, "points": list(map(_point, c["points"]))}) for c in data.pop("curves")]
            require_integer("dim", data["dim"], 1)
            if data["exact"] is not None:
                require_number("exact", data["exact"])
            return cls(curves=curves, **{**data, "fields": require_section("fields", data["fields"])})
        except (InputError, TypeError, KeyError, AttributeError):
            raise InputError(f"{path} is no file of curves that scripts/benchmark.py wrote.") from None

    def with_those_of(self, other: "Family") -> "Family":
        """This family with the curves of ``other`` whose contender and seed are not in it."""
        own = {(c.contender, c.seed) for c in self.curves}
        more = [c for c in other.curves if (c.contender, c.seed) not in own]
        return replace(self, curves=self.curves + more, versions={**other.versions, **self.versions})


def _point(saved: dict) -> Point:
    """The point ``saved`` in a file, in which numbers that are not finite are words."""
    return Point(**{**saved, "numbers": {name: n for name, n in saved["numbers"].items() if not isinstance(n, str)}})


def versions() -> dict[str, str]:
    """The versions of this package, and of `PACKAGES` as far as they are installed."""
    found = {"ocp_torch": __version__}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def read_beside(beside: object) -> list[Family]:
    """The families in the files, or in all JSON files in the folders, that ``beside`` lists. Raises `InputError`."""
    if not isinstance(beside, list):
        raise InputError(f"beside is {beside!r}, but must be a list of files and folders of benchmarks.")
    found: list[Family] = []
    for each in map(Path, map(str, beside)):
        files = {FILE: [each], FOLDER: sorted(each.rglob("*.json"))}.get(kind(each) or "", [])
        if not files:
            raise InputError(f"beside names {each}, but there is no file of curves there.")
        found += map(Family.read, files)
    return found


def joined(families: Sequence[Family]) -> list[Family]:
    """One family for each problem, those of a kind in order of dimension; of equal curves the first one counts."""
    found: dict[tuple, Family] = {}
    for one in families:
        key = (one.kind, one.dim)
        found[key] = found[key].with_those_of(one) if key in found else one
    order = list(dict.fromkeys(f.kind for f in found.values()))
    return sorted(found.values(), key=lambda f: (order.index(f.kind), f.dim))


def titles(families: list[Family]) -> list[str]:
    """A title for each family: its problem and dimension, and the fields in which it differs from others of that name."""
    found = []
    for one in families:
        others = [f.fields for f in families if f.problem == one.problem]
        differ = [k for k, v in one.fields.items() if k != "dim" and any(fields.get(k) != v for fields in others)]
        found.append(", ".join([one.problem, f"d = {one.dim}", *(f"{k} = {one.fields[k]}" for k in differ)]))
    return found


def tables(families: list[Family], gap: float) -> str:
    """The table of each family, and the exponents of `by_dimension`, as Markdown."""
    named = zip(titles(families), families, strict=True)
    text = [f"## {title}\n\n{contest_table(f.curves, f.exact)}" for title, f in named]
    for name, pairs in by_dimension(families, gap).items():
        listed = ", ".join(f"{seconds:.3g} in {d}" for d, seconds in pairs)
        text.append(
            f"{name}: CPU seconds to a simulated gap of {100.0 * gap:g} % as d^{exponent(pairs):.2g} ({listed} dimensions)."
        )
    return "\n\n".join(text)


def pictures(families: list[Family], gap: float) -> dict:
    """Figures by name: one family against samples and seconds or several against seconds, and seconds against dimension."""
    (first, *more), costs = families, by_dimension(families, gap)
    found = {"benchmark": side_by_side(families) if more else plot(first.curves, first.exact)}
    return found | ({"dimensions": cost_figure(costs, gap)} if costs else {})


def side_by_side(families: list[Family]):
    """Sub-optimality of the controller and the simulated gap against CPU seconds of training, a column for each family."""
    figure = blank_figure(3.2 * len(families) + 1.0, 6.5)
    axes = figure.subplots(2, len(families), squeeze=False, sharex="col", sharey="row")
    names = list(dict.fromkeys(c.contender for f in families for c in f.curves))
    rows = ("controller above the optimum, %", "simulated gap, %")
    for j, family in enumerate(families):
        heights = (lambda p, o=family.optimum: 100.0 * (p.perf / o - 1.0), lambda p: 100.0 * p.simulated)
        for i, height in enumerate(heights):
            for name, own in by_contender(family.curves).items():
                draw(axes[i, j], own, lambda p: p.seconds, height, f"C{names.index(name)}", name)
            axes[i, j].set(xscale="log", yscale="log", ylabel=rows[i] if j == 0 else "")
            axes[i, j].grid(alpha=0.3)
        axes[0, j].set_title(titles(families)[j], fontsize=10)
        axes[1, j].set_xlabel("CPU seconds of training")
    shown = {label: line for axis in axes.flat for line, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(list(shown.values()), list(shown), loc="outside lower center", ncols=len(shown), fontsize=8)
    return figure


def seconds_until(curve: Curve, gap: float) -> float:
    """CPU seconds of training from which on the simulated gap is at most ``gap``, between points by a power law; infinite
    where that never happens."""
    within = len(curve.points)
    while within and curve.points[within - 1].simulated <= gap:
        within -= 1
    if within == len(curve.points):
        return math.inf
    before, after = curve.points[max(within - 1, 0)], curve.points[within]
    if not within or not math.isfinite(before.simulated) or min(before.seconds, after.simulated) <= 0.0:
        return after.seconds
    part = math.log(gap / before.simulated) / math.log(after.simulated / before.simulated)
    return before.seconds * (after.seconds / before.seconds) ** part


def by_dimension(families: list[Family], gap: float) -> dict[str, list[tuple[int, float]]]:
    """For each contender on each problem with three dimensions or more: pairs of a dimension and the median over seeds of
    `seconds_until` the simulated gap is at most ``gap``, where every seed reaches that."""
    found: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for family in families:
        for name, own in by_contender(family.curves).items():
            seconds = [seconds_until(curve, gap) for curve in own]
            if all(map(math.isfinite, seconds)):
                found.setdefault((family.kind, name), []).append((family.dim, median(seconds)))
    return {f"{kind.split()[0]}, {name}": pairs for (kind, name), pairs in found.items() if len(pairs) >= FEWEST}


def exponent(pairs: list[tuple[int, float]]) -> float:
    """The exponent of the power law that fits ``pairs`` best, in logarithms."""
    d, seconds = np.log(np.array(pairs)).T
    return float(np.polyfit(d, seconds, 1)[0])


def cost_figure(costs: dict[str, list[tuple[int, float]]], gap: float):
    """A figure of the result of `by_dimension`, with the exponent of each curve."""
    figure = blank_figure(5.0, 4.0)
    axis = figure.subplots()
    for name, pairs in costs.items():
        axis.plot(*zip(*pairs, strict=True), marker="o", label=f"{name}: d^{exponent(pairs):.2g}")
    axis.set(xscale="log", yscale="log", xlabel="d", ylabel=f"CPU seconds to a simulated gap of {100.0 * gap:g} %")
    dims = sorted({d for pairs in costs.values() for d, _ in pairs})
    axis.set_xticks(dims, labels=[str(d) for d in dims])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return figure
