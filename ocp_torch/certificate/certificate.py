"""The certificate: bounds, performances, standard errors and what they rest on."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path

from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.estimate import CONFIDENCE, Estimate
from ocp_torch.errors import InputError, require_integer, require_number, visible
from ocp_torch.problems.needs import GUESSED, Need

SCHEMA = 2
# Of a problem or a method, in characters.
LONGEST_NAME = 120


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

    @classmethod
    def read(cls, certificate: dict) -> Run:
        """What ``certificate``, as a file has it, says. Raises `InputError` where it does not say it, or absurdly."""
        said = {name: certificate[name] for name in cls.__dataclass_fields__ if name in certificate}
        for name in ("problem", "method", *({"stopped"} & said.keys())):
            if not isinstance(said.get(name), str):
                raise InputError("the controller's certificate does not say which problem and method it is of.")
            said[name] = visible(said[name], LONGEST_NAME)
        for name in {"seed", "step", "samples"} & said.keys():
            require_integer(f"{name} of the certificate", said[name], 0, maximum=2**63)
        if "train_seconds" in said:
            require_number("train_seconds of the certificate", said["train_seconds"], at_least=0.0)
        return cls(**said)


@dataclass(frozen=True)
class Certificate:
    """`F_M <= OPT <= Perf(u) <= J`: each number an `Estimate`, or `None` where it does not apply.

    ``lower``, ``upper``, ``perf`` and ``baseline`` map the names of `certificate.json` to estimates; ``searches`` says how
    each supremum behind them was found, ``speaks`` whether `J` and `G` are about the controller that is handed out.
    ``confidence`` is the level of the intervals; ``subject`` names the controller in ``perf`` that all this is about, by
    default the best of them; ``perf_lower`` bounds its performance from below without simulation. ``contradiction`` is the
    sentence that says why nothing counts, where two bounds exclude each other.
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
    confidence: float = CONFIDENCE
    subject: str | None = None
    perf_lower: dict[str, Estimate | None] = field(default_factory=dict)
    contradiction: str | None = None

    def needs(self, name: str) -> tuple[Need, ...]:
        """What the bound ``name`` rests on."""
        return self.assumptions.needs(name)

    def counts(self, name: str) -> bool:
        """Whether the bound ``name`` may enter a gap: what it rests on holds, and nothing of it is guessed."""
        return self.stands and all(need.counts for need in self.needs(name))

    def conditional(self, name: str) -> bool:
        """Whether the bound ``name`` rests on a guess that nothing refutes: it is one if the guess is right."""
        needs = self.needs(name)
        return self.stands and all(n.holds for n in needs) and any(n.basis == GUESSED for n in needs)

    @property
    def stands(self) -> bool:
        """Whether the problem is one, and nothing contradicts anything: without that no number counts."""
        return self.assumptions.problem_holds and self.contradiction is None

    @property
    def best_lower(self) -> tuple[str, float] | None:
        """The lower bound that counts with the highest lower end of its interval, and that end."""
        return self._highest(self.counts)

    @property
    def best_upper(self) -> tuple[str, float] | None:
        """The bound on the controller handed out that counts with the lowest upper end, and that end; no simulation."""
        usable = {n: e for n, e in self.upper.items() if self.counts(n) and self.speaks.get(n, True)}
        return _best(min, {n: self._ends(e)[1] for n, e in usable.items() if known(e)})

    @property
    def best_perf(self) -> tuple[str, float] | None:
        """The controller handed out and the upper end of its simulated performance, bias included, if that counts."""
        name = self.controller
        return None if name is None or not self.stands else (name, self._ends(self.perf[name])[1])

    @property
    def controller(self) -> str | None:
        """The controller that all this is about: the ``subject``, or the one with the smallest simulated performance."""
        mine = lambda name: self.subject is None or name == self.subject
        best = _best(min, {n: self._ends(e)[1] for n, e in self.perf.items() if known(e) and mine(n)})
        return None if best is None else best[0]

    @property
    def gap(self) -> dict:
        """From the best lower bound that counts to the best upper bound, and to the simulated performance, relative to the
        lower; between the far ends of their intervals. ``conditional``: what bounds that rest on a guess would make of it."""
        lower, upper, perf = self.best_lower, self.best_upper, self.best_perf
        supposed = self._highest(self.conditional)
        both = [g for g in (_relative_gap(supposed, upper), _relative_gap(supposed, perf)) if g is not None]
        return {
            "certified": _relative_gap(lower, upper),
            "simulated": _relative_gap(lower, perf),
            "conditional": min(both, default=None),
            "lower_from": lower[0] if lower else None,
            "upper_from": upper[0] if upper else None,
        }

    @property
    def plain_gap(self) -> float | None:
        """The simulated gap between values, without errors on top: to decide by, not to claim."""
        lower, perf = self.best_lower, self.best_perf
        if lower is None or perf is None:
            return None
        values = self.lower[lower[0]].value, self.perf[perf[0]].value
        return _relative_gap(*((name, value) for (name, _), value in zip((lower, perf), values, strict=True)))

    @property
    def suboptimality(self) -> dict:
        """How much more than `OPT` the controller costs, relative to it: ``at_least`` and ``at_most``, jointly at the
        level of ``confidence`` (the level of each interval that enters is raised accordingly); `None` where unknown.
        ``takes`` are the sentences on what else the two rest on."""
        best, lower, upper = self.best_perf, self.best_lower, self.best_upper
        perfs = [e for e in self.perf.values() if known(e)]
        level = 1.0 - (1.0 - self.confidence) / (len(perfs) + 2)
        found = {"at_least": None, "at_most": None, "takes": []}
        if best is None:
            return found
        low, high = self.perf[best[0]].interval(level)
        # Whatever any controller costs, OPT does not exceed it.
        above = [e.interval(level)[1] for e in perfs] + ([self.upper[upper[0]].interval(level)[1]] if upper else [])
        if min(above) > 0.0:
            found["at_least"] = max(0.0, low / min(above) - 1.0)
        if lower is not None and (under := self.lower[lower[0]].interval(level)[0]) > 0.0:
            found["at_most"] = max(0.0, high / under - 1.0)
            found["takes"] = [need.sentence for need in self.needs(lower[0])]
        return found

    @property
    def share(self) -> dict:
        """The part of what control can gain over doing nothing that is certainly achieved, by both upper sides."""
        zero = self.baseline.get("zero")
        least = self._ends(zero)[0] if known(zero) else None
        return {
            "certified": _share(self.best_lower, self.best_upper, least),
            "simulated": _share(self.best_lower, self.best_perf, least),
        }

    @property
    def hold(self) -> bool:
        """Whether every check passed and no two bounds contradict each other; a guess that is not used is no matter."""
        return self.assumptions.hold and self.contradiction is None

    def to_dict(self) -> dict:
        """The stable schema of `certificate.json`; what does not apply is null."""
        one = lambda e: e.to_dict(self.confidence) if known(e) else None
        bound = lambda name, e: None if not known(e) else {**one(e), **self._standing(name)}
        return {
            "schema": SCHEMA,
            **vars(self.run),
            "exact": self.exact,
            "confidence": self.confidence,
            "controller": self.controller,
            **{side: {n: bound(n, e) for n, e in getattr(self, side).items()} for side in ("lower", "upper")},
            **{group: {n: one(e) for n, e in getattr(self, group).items()} for group in ("perf", "baseline")},
            "gap": self.gap,
            "share": self.share,
            "suboptimality": self.suboptimality,
            **({"perf_lower": {name: one(e) for name, e in self.perf_lower.items()}} if self.perf_lower else {}),
            "assumptions": {**self.assumptions.to_dict(), "hold": self.hold},
            "contradiction": self.contradiction,
            "warnings": list(self.warnings),
        }

    def _standing(self, name: str) -> dict:
        """What the bound ``name`` rests on, whether it counts, and what it supposes where a guess may be right."""
        guesses = [need.condition for need in self.needs(name) if need.basis == GUESSED]
        supposed = " and ".join(guesses) if self.conditional(name) else ""
        counts = self.counts(name) and self.speaks.get(name, True)
        rests_on = {need.name: need.basis for need in self.needs(name)}
        return {"rests_on": rests_on, "counts": counts, **({"if": supposed} if supposed else {})}

    def save(self, path: Path) -> None:
        """Write `certificate.json`."""
        path.write_text(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    def _ends(self, estimate: Estimate) -> tuple[float, float]:
        return estimate.interval(self.confidence)

    def _highest(self, usable) -> tuple[str, float] | None:
        """The lower bound with the highest lower end among those that are ``usable``."""
        return _best(max, {n: self._ends(e)[0] for n, e in self.lower.items() if known(e) and usable(n)})


def known(estimate: Estimate | None) -> bool:
    """Whether there is a number."""
    return estimate is not None and estimate.finite


def _best(choose, ends: dict[str, float]) -> tuple[str, float] | None:
    if not ends:
        return None
    name = choose(ends, key=ends.get)
    return name, ends[name]


def _relative_gap(lower: tuple[str, float] | None, upper: tuple[str, float] | None) -> float | None:
    """Relative to the lower bound; `None` where that is not positive, or where the two cross, as errors may make them."""
    if lower is None or upper is None or lower[1] <= 0.0 or upper[1] < lower[1]:
        return None
    return (upper[1] - lower[1]) / lower[1]


def _share(lower: tuple[str, float] | None, upper: tuple[str, float] | None, zero: float | None) -> float | None:
    if lower is None or upper is None or zero is None or upper[1] < lower[1]:
        return None
    gain = zero - lower[1]
    return 1.0 - (upper[1] - lower[1]) / gain if gain > 0.0 and math.isfinite(gain) else None
