"""The certificate: bounds, performances, standard errors and the assumptions they rest on."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

from ocp_torch.certificate.assumptions import Assumptions
from ocp_torch.certificate.estimate import Estimate

SCHEMA = 1


@dataclass(frozen=True)
class Run:
    """What a certificate says about the run it belongs to."""

    problem: str
    method: str
    seed: int = 0
    step: int = 0
    samples: int = 0
    train_seconds: float = 0.0
    stopped: str = "steps"  # why training ended: steps, target_gap, max_seconds, not_finite or failed


@dataclass(frozen=True)
class Certificate:
    """`F_M <= OPT <= Perf(u) <= J`: each number an `Estimate`, or `None` where it does not apply.

    ``lower``, ``upper``, ``perf`` and ``baseline`` map the names of `certificate.json` to estimates; ``searches`` says how
    each supremum behind them was found, ``speaks`` whether `J` and `G` are about the controller that is handed out.
    ``confidence`` is the level of the intervals; ``subject`` names the controller in ``perf`` that all this is about, by
    default the best of them; ``perf_lower`` bounds its performance from below without simulation.
    """

    run: Run
    exact: float | None
    lower: dict[str, Estimate | None]
    upper: dict[str, Estimate | None]
    perf: dict[str, Estimate | None]
    baseline: dict[str, Estimate | None]
    assumptions: Assumptions
    warnings: list[str] = field(default_factory=list)
    searches: list[str] = field(default_factory=list)
    speaks: dict[str, bool] = field(default_factory=dict)
    confidence: float = 0.95
    subject: str | None = None
    perf_lower: dict[str, Estimate | None] = field(default_factory=dict)

    @property
    def best_lower(self) -> tuple[str, float] | None:
        """Name and value of the largest lower bound whose assumptions hold."""
        sound = self.assumptions.problem_holds
        usable = {"F_M": sound and self.assumptions.occupation_holds, "shifted": sound, "rigorous": sound}
        return _best(max, self.lower, usable)

    @property
    def best_upper(self) -> tuple[str, float] | None:
        """The smallest upper bound of the controller handed out whose assumptions hold; no simulation in it."""
        known = self.assumptions
        holds = known.problem_holds and known.value_holds and known.cost_holds
        usable = {name: holds and self.speaks.get(name, True) for name in ("J", "G")}
        usable["J"] = usable["J"] and known.regular_holds
        usable["lagrangian"] = known.problem_holds and known.regular_holds
        return _best(min, self.upper, {**usable, "evaluation": known.problem_holds})

    @property
    def best_perf(self) -> tuple[str, float] | None:
        """The controller with the smallest simulated performance (or the ``subject``), and that with its bias and two
        standard errors."""
        mine = lambda name: self.subject is None or name == self.subject
        known = {name: e for name, e in self.perf.items() if e is not None and e.finite and mine(name)}
        if not known or not self.assumptions.problem_holds:
            return None
        name = min(known, key=lambda n: known[n].above)
        return name, known[name].above

    @property
    def gap(self) -> dict:
        """Relative distance from the best lower bound to the best upper bound, and to the best simulated performance."""
        lower, upper, perf = self.best_lower, self.best_upper, self.best_perf
        return {
            "certified": _relative_gap(lower, upper),
            "simulated": _relative_gap(lower, perf),
            "lower_from": lower[0] if lower else None,
            "upper_from": upper[0] if upper else None,
        }

    @property
    def plain_gap(self) -> float | None:
        """The simulated gap as measured, without bias and standard errors on top: to decide by, not to claim."""
        best = self.best_perf
        return None if best is None else _relative_gap(self.best_lower, (best[0], self.perf[best[0]].value))

    @property
    def suboptimality(self) -> dict:
        """How much more than `OPT` the controller costs, relative to it: ``at_least`` and ``at_most``, jointly at the
        level of ``confidence`` (the level of each interval that enters is raised accordingly); `None` where unknown."""
        best, lower, upper = self.best_perf, self.best_lower, self.best_upper
        known = [e for e in self.perf.values() if e is not None and e.finite]
        level = 1.0 - (1.0 - self.confidence) / (len(known) + 2)
        none = {"at_least": None, "at_most": None}
        if best is None:
            return none
        low, high = self.perf[best[0]].interval(level)
        # Whatever any controller costs, OPT does not exceed it.
        above = [e.interval(level)[1] for e in known] + ([self.upper[upper[0]].interval(level)[1]] if upper else [])
        found = dict(none)
        if min(above) > 0.0:
            found["at_least"] = max(0.0, low / min(above) - 1.0)
        if lower is not None and (under := self.lower[lower[0]].interval(level)[0]) > 0.0:
            found["at_most"] = max(0.0, high / under - 1.0)
        return found

    def without_contradictions(self) -> Certificate:
        """Itself, or, where `F_M` is above an upper bound on `OPT` by more than chance allows, with `F_M` taken out."""
        low, sure = self.lower.get("F_M"), 1.0 - (1.0 - self.confidence) / 10.0
        if low is None or not low.finite or not self.assumptions.occupation_holds:
            return self
        above = {name: e.interval(sure)[1] for name, e in self.perf.items() if e is not None and e.finite}
        best = self.best_upper
        if best is not None:
            above[best[0]] = self.upper[best[0]].interval(sure)[1]
        name = min(above, key=above.get, default=None)
        if name is None or low.interval(sure)[0] <= above[name]:
            return self
        warning = f"F_M is not used: it is above the upper bound {above[name]:.6g} ({name}), so M is too small."
        assumptions = replace(self.assumptions, occupation_holds=False)
        return replace(self, assumptions=assumptions, warnings=[*self.warnings, warning])

    @property
    def share(self) -> dict:
        """The part of what control can gain over doing nothing that is certainly achieved, by both upper sides."""
        zero = self.baseline.get("zero")
        return {
            "certified": _share(self.best_lower, self.best_upper, zero),
            "simulated": _share(self.best_lower, self.best_perf, zero),
        }

    def to_dict(self) -> dict:
        """The stable schema of `certificate.json`; what does not apply is null."""
        level = self.confidence
        one = lambda e: e.to_dict(level) if e is not None and e.finite else None
        groups = ("lower", "upper", "perf", "baseline")
        as_json = {group: {name: one(e) for name, e in getattr(self, group).items()} for group in groups}
        return {
            "schema": SCHEMA,
            **vars(self.run),
            "exact": self.exact,
            "confidence": self.confidence,
            **as_json,
            "gap": self.gap,
            "share": self.share,
            "suboptimality": self.suboptimality,
            **({"perf_lower": {name: one(e) for name, e in self.perf_lower.items()}} if self.perf_lower else {}),
            "assumptions": self.assumptions.to_dict(),
            "warnings": list(self.warnings),
        }

    def save(self, path: Path) -> None:
        """Write `certificate.json`."""
        path.write_text(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")


def _best(choose, estimates: dict[str, Estimate | None], usable: dict[str, bool]) -> tuple[str, float] | None:
    known = {n: e.value for n, e in estimates.items() if e is not None and e.finite and usable.get(n, False)}
    if not known:
        return None
    name = choose(known, key=known.get)
    return name, known[name]


def _relative_gap(lower: tuple[str, float] | None, upper: tuple[str, float] | None) -> float | None:
    if lower is None or upper is None or lower[1] <= 0.0:
        return None
    return (upper[1] - lower[1]) / lower[1]


def _share(lower, upper, zero: Estimate | None) -> float | None:
    if lower is None or upper is None or zero is None or not zero.finite:
        return None
    gain = zero.value - lower[1]
    return 1.0 - (upper[1] - lower[1]) / gain if gain > 0.0 and math.isfinite(gain) else None


def table(certificate: dict, searches: list[str] = ()) -> str:
    """The certificate (as a dict of its schema) as a table for the terminal, and how its suprema were found."""
    exact = certificate["exact"]
    lines = [f"{certificate['problem']} / {certificate['method']}, seed {certificate['seed']}", ""]
    covered = f"± {100.0 * certificate['confidence']:.6g} %" if "confidence" in certificate else "± se"
    header = f"{'':26}{'value':>14}{covered:>11}{'of it bias':>11}" + (f"{'vs OPT':>12}" if exact else "")
    lines += [header, "-" * len(header)]

    def row(label: str, estimate: dict | None) -> None:
        if estimate is None:
            return
        bias = f"{estimate['bias']:11.1e}" if "bias" in estimate else " " * 11
        against = f"{100.0 * (estimate['value'] / exact - 1.0):+11.4f}%" if exact else ""
        half = estimate["interval"][1] - estimate["value"] if "interval" in estimate else estimate["se"]
        lines.append(f"{label:26}{estimate['value']:14.8f}{half:11.1e}{bias}{against}")

    row("lower: F_M", certificate["lower"]["F_M"])
    row("lower: shifted", certificate["lower"]["shifted"])
    row("lower: rigorous", certificate["lower"].get("rigorous"))
    if exact is not None:
        lines.append(f"{'OPT (exact)':26}{exact:14.8f}")
    row("Perf: controller from V", certificate["perf"].get("value"))
    row("Perf: controller w/mu", certificate["perf"].get("density"))
    for name, estimate in certificate.get("perf_lower", {}).items():
        row(f"Perf, at least: {name}", estimate)
    row("Perf: this controller", certificate["perf"].get("given"))
    for name, label in (("lagrangian", "Lagrangian"), ("evaluation", "evaluation"), ("G", "G"), ("J", "J")):
        row(f"upper: {label}", certificate["upper"].get(name))
    row("Perf: doing nothing", certificate["baseline"]["zero"])
    lines.append("-" * len(header))
    gap, share = certificate["gap"], certificate["share"]
    for kind in ("certified", "simulated"):
        if gap[kind] is not None:
            part = f", {100 * share[kind]:.2f}% of the gain over doing nothing" if share[kind] is not None else ""
            lines.append(f"gap, {kind}: {100.0 * gap[kind]:.4f}%{part}")
    lines += in_words(certificate)
    lines += searches
    lines += [f"warning: {warning}" for warning in certificate["warnings"]]
    return "\n".join(lines)


def in_words(certificate: dict) -> list[str]:
    """The sub-optimality of the controller as a sentence, if there is anything to say."""
    found = certificate.get("suboptimality") or {}
    percent = lambda x: f"{100.0 * x:.3g} %"
    least, most = found.get("at_least"), found.get("at_most")
    parts = [f"at most {percent(most)}"] if most is not None else []
    if least:
        parts.append(f"at least {percent(least)}")
    if not parts:
        return []
    return [
        f"the controller is {' and '.join(parts)} worse than the optimum ({percent(certificate['confidence'])} sure)"
    ]
