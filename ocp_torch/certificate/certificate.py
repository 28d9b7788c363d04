"""The certificate: bounds, performances, standard errors and the assumptions they rest on."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
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
    stopped: str = "steps"  # why training ended: steps, target_gap, max_seconds or not_finite


@dataclass(frozen=True)
class Certificate:
    """`F_M <= OPT <= Perf(u) <= J`: each number an `Estimate`, or `None` where it does not apply.

    ``lower``, ``upper``, ``perf`` and ``baseline`` map the names of `certificate.json` to estimates; ``searches`` says how
    each supremum behind them was found, ``speaks`` whether `J` and `G` are about the controller that is handed out.
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

    @property
    def best_lower(self) -> tuple[str, float] | None:
        """Name and value of the largest lower bound whose assumptions hold."""
        usable = {"F_M": self.assumptions.occupation_holds, "shifted": True, "rigorous": True}
        return _best(max, self.lower, usable)

    @property
    def best_upper(self) -> tuple[str, float] | None:
        """The smallest upper bound of the controller handed out whose assumptions hold; no simulation in it."""
        holds = self.assumptions.value_holds
        usable = {name: holds and self.speaks.get(name, True) for name in ("J", "G")}
        return _best(min, self.upper, {**usable, "lagrangian": True})

    @property
    def best_perf(self) -> tuple[str, float] | None:
        """The controller with the smallest simulated performance, and that with its bias and two standard errors."""
        known = {name: e for name, e in self.perf.items() if e is not None and e.finite}
        if not known:
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
    def share(self) -> dict:
        """The part of what control can gain over doing nothing that is certainly achieved, by both upper sides."""
        zero = self.baseline.get("zero")
        return {
            "certified": _share(self.best_lower, self.best_upper, zero),
            "simulated": _share(self.best_lower, self.best_perf, zero),
        }

    def to_dict(self) -> dict:
        """The stable schema of `certificate.json`; what does not apply is null."""
        groups = {name: getattr(self, name) for name in ("lower", "upper", "perf", "baseline")}
        as_json = {
            k: {n: e.to_dict() if e is not None and e.finite else None for n, e in g.items()} for k, g in groups.items()
        }
        return {
            "schema": SCHEMA,
            **vars(self.run),
            "exact": self.exact,
            **as_json,
            "gap": self.gap,
            "share": self.share,
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
    header = f"{'':26}{'value':>14}{'± se':>11}{'± bias':>11}" + (f"{'vs OPT':>12}" if exact else "")
    lines += [header, "-" * len(header)]

    def row(label: str, estimate: dict | None) -> None:
        if estimate is None:
            return
        bias = f"{estimate['bias']:11.1e}" if "bias" in estimate else " " * 11
        against = f"{100.0 * (estimate['value'] / exact - 1.0):+11.4f}%" if exact else ""
        lines.append(f"{label:26}{estimate['value']:14.8f}{estimate['se']:11.1e}{bias}{against}")

    row("lower: F_M", certificate["lower"]["F_M"])
    row("lower: shifted", certificate["lower"]["shifted"])
    row("lower: rigorous", certificate["lower"].get("rigorous"))
    if exact is not None:
        lines.append(f"{'OPT (exact)':26}{exact:14.8f}")
    row("Perf: controller from V", certificate["perf"]["value"])
    row("Perf: controller w/mu", certificate["perf"]["density"])
    for name, label in (("lagrangian", "Lagrangian"), ("G", "G"), ("J", "J")):
        row(f"upper: {label}", certificate["upper"][name])
    row("Perf: doing nothing", certificate["baseline"]["zero"])
    lines.append("-" * len(header))
    gap, share = certificate["gap"], certificate["share"]
    for kind in ("certified", "simulated"):
        if gap[kind] is not None:
            part = f", {100 * share[kind]:.2f}% of the gain over doing nothing" if share[kind] is not None else ""
            lines.append(f"gap, {kind}: {100.0 * gap[kind]:.4f}%{part}")
    lines += searches
    lines += [f"warning: {warning}" for warning in certificate["warnings"]]
    return "\n".join(lines)
