"""The certificate: bounds, performances, standard errors and what they rest on; and the gaps between its sides."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from ocp_torch.certificate.bounds import BOUNDS
from ocp_torch.certificate.bounds.bound import LOWER, PERFORMANCE, UPPER
from ocp_torch.certificate.checks.assumptions import Assumptions
from ocp_torch.certificate.gaps import Side, relative_gap, share
from ocp_torch.certificate.settings import Run
from ocp_torch.certificate.statistics.estimate import CONFIDENCE, Estimate, known, known_of
from ocp_torch.fields.subsolution import Subsolution
from ocp_torch.maths.jets import Field
from ocp_torch.problems.needs import GUESSED, Need

SCHEMA = 2  # of `certificate.json`


@dataclass(frozen=True)
class Certificate:
    """`F_M <= OPT <= Perf(u) <= J`: each number an `Estimate`, or `None` where it does not apply.

    ``lower``, ``upper``, ``perf_lower`` (bounds of the listed sides, see `ocp_torch.certificate.bounds`), ``perf`` and
    ``baseline`` (simulated) map the names of `certificate.json` to estimates; ``searches`` says how each supremum behind
    them was found, ``about`` by name which controller's performance an upper bound bounds, if any. ``confidence`` is the
    level of the intervals; ``subject`` names the controller in ``perf`` that is handed out, by default the best of them.
    ``contradiction`` is the sentence that says why nothing counts, where two bounds exclude each other; ``refuted`` are the
    names of guesses that another bound excludes. ``outside`` is the part of the discounted time that the controller spends
    outside the box of a system in physical units. ``held_for`` is the time for which it holds each control, `None` where it
    acts at every instant; ``followed`` is the one whose closed loop was fitted, by the density ``occupation``, to draw.
    ``subsolution`` is the function of the shifted bound, where that is not the `V` that was certified.
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
    about: dict[str, str | None] = field(default_factory=dict)
    confidence: float = CONFIDENCE
    subject: str | None = None
    perf_lower: dict[str, Estimate | None] = field(default_factory=dict)
    contradiction: str | None = None
    refuted: frozenset[str] = frozenset()
    outside: Estimate | None = None
    held_for: float | None = None
    followed: str | None = None
    occupation: Field | None = field(default=None, compare=False)
    subsolution: Subsolution | None = field(default=None, compare=False)

    def needs(self, name: str) -> tuple[Need, ...]:
        """What the bound ``name`` rests on; nothing for simulations, the truth, and names that are not listed."""
        found = next((bound.needs(self.assumptions) for bound in BOUNDS if bound.name == name), ())
        return tuple(replace(need, holds=False) if need.name in self.refuted else need for need in found)

    def counts(self, name: str) -> bool:
        """Whether the bound ``name`` may enter a gap: what it rests on holds, and nothing of it is guessed."""
        return self.stands and all(need.counts for need in self.needs(name))

    def conditional(self, name: str) -> bool:
        """Whether the bound ``name`` rests on a guess that nothing refutes: it is a bound if the guess is right."""
        needs = self.needs(name)
        return self.stands and all(n.holds for n in needs) and any(n.basis == GUESSED for n in needs)

    @property
    def stands(self) -> bool:
        """Whether the problem is well posed and no two bounds contradict each other: else no number counts."""
        return self.assumptions.problem_holds and self.contradiction is None

    @property
    def best_lower(self) -> Side | None:
        """The lower bound that counts with the highest lower end of its interval, and that end."""
        return self._highest(self.counts)

    @property
    def best_upper(self) -> Side | None:
        """The bound on the controller handed out that counts with the lowest upper end, and that end; no simulation."""
        return self.best_upper_of(self.subject)

    def best_upper_of(self, controller: str | None) -> Side | None:
        """The bound on any ``controller`` that counts with the lowest upper end, and that end; no simulation."""
        about = lambda name: self.about.get(name, controller) == controller
        return self._lowest(self.upper, lambda name: self.counts(name) and about(name))

    @property
    def certified(self) -> dict[str, float | None]:
        """The certified gap of each controller that is known."""
        return {name: relative_gap(self.best_lower, self.best_upper_of(name)) for name in known_of(self.perf)}

    @property
    def best_certified(self) -> str | None:
        """The controller with the lowest upper bound that counts."""
        found = {name: self.best_upper_of(name) for name in known_of(self.perf)}
        ends = {name: side[1] for name, side in found.items() if side is not None}
        return min(ends, key=ends.__getitem__, default=None)

    @property
    def best_perf(self) -> Side | None:
        """The controller handed out and the upper end of its simulated performance, bias included, if that counts."""
        return self._handed_out if self.stands else None

    @property
    def controller(self) -> str | None:
        """The controller of the certificate: the ``subject``, or the one with the lowest simulated performance."""
        return None if self._handed_out is None else self._handed_out[0]

    @property
    def gap(self) -> dict:
        """Gaps from the best lower bound that counts to the best upper bound, and to the simulated performance, relative to
        the lower; between the far ends of their intervals. ``conditional`` is the smaller gap for a lower bound that rests on
        a guess, where that is higher than all that count."""
        lower, upper, perf = self.best_lower, self.best_upper, self.best_perf
        supposed = self._highest(lambda name: self.counts(name) or self.conditional(name))
        supposed = None if supposed == lower else supposed
        both = [g for g in (relative_gap(supposed, upper), relative_gap(supposed, perf)) if g is not None]
        return {
            "certified": relative_gap(lower, upper),
            "simulated": relative_gap(lower, perf),
            "conditional": min(both, default=None),
            "certified_of": self.certified,
            "lower_from": lower[0] if lower else None,
            "upper_from": upper[0] if upper else None,
        }

    @property
    def supposed_gap(self) -> float | None:
        """The simulated gap if every lower bound counted, whatever it rests on: to decide by, not to claim. `None` where the
        sides cross, as they may where `M` is too small."""
        return relative_gap(self._highest(lambda name: True), self.best_perf)

    @property
    def plain_gap(self) -> float | None:
        """The simulated gap between values, without errors on top: to decide by, not to claim."""
        lower, perf = self.best_lower, self.best_perf
        if lower is None or perf is None:
            return None
        (low, _), (high, _) = lower, perf
        return relative_gap((low, known_of(self.lower)[low].value), (high, known_of(self.perf)[high].value))

    @property
    def suboptimality(self) -> dict:
        """How much more than `OPT` the controller costs, relative to it: ``at_least`` and ``at_most``, jointly at the
        level of ``confidence`` (the level of each interval that enters is raised accordingly); `None` where unknown.
        ``takes`` are the sentences on what else the two rest on."""
        perf, lower, upper = self.best_perf, self.best_lower, self.best_upper
        perfs = known_of(self.perf)
        level = 1.0 - (1.0 - self.confidence) / (len(perfs) + 2)
        found: dict[str, float | list[str] | None] = {"at_least": None, "at_most": None, "takes": []}
        if perf is None:
            return found
        low, high = perfs[perf[0]].interval(level)
        # Whatever any controller costs, OPT does not exceed it.
        above = [e.interval(level)[1] for e in perfs.values()]
        above += [known_of(self.upper)[upper[0]].interval(level)[1]] if upper else []
        if min(above) > 0.0:
            found["at_least"] = max(0.0, low / min(above) - 1.0)
        if lower is not None and (under := known_of(self.lower)[lower[0]].interval(level)[0]) > 0.0:
            found["at_most"] = max(0.0, high / under - 1.0)
            found["takes"] = [need.sentence for need in self.needs(lower[0])]
        return found

    @property
    def share(self) -> dict:
        """The part of what control can gain over doing nothing that is certainly achieved, by both upper sides."""
        zero, lower = self.baseline.get("zero"), self.best_lower
        least = zero.interval(self.confidence)[0] if known(zero) else None
        return {"certified": share(lower, self.best_upper, least), "simulated": share(lower, self.best_perf, least)}

    @property
    def hold(self) -> bool:
        """Whether every check passed, what each number rests on holds, and no two bounds contradict each other; guesses are
        left aside."""
        shown = [*known_of(self.lower), *known_of(self.upper)]
        needs = [need for name in shown for need in self.needs(name) if need.basis != GUESSED]
        return self.assumptions.hold and all(need.holds for need in needs) and self.contradiction is None

    def to_dict(self) -> dict:
        """What `certificate.json` holds: a stable schema, in which what does not apply is null."""
        one = lambda e: e.to_dict(self.confidence) if known(e) else None
        return {
            "schema": SCHEMA,
            **vars(self.run),
            "exact": self.exact,
            "confidence": self.confidence,
            "controller": self.controller,
            **({} if self.held_for is None else {"held_for": self.held_for}),
            **{side: {n: self._bound(n, e) for n, e in getattr(self, side).items()} for side in (LOWER, UPPER)},
            **{group: {n: one(e) for n, e in getattr(self, group).items()} for group in ("perf", "baseline")},
            "gap": self.gap,
            "share": self.share,
            "suboptimality": self.suboptimality,
            **({PERFORMANCE: {name: one(e) for name, e in self.perf_lower.items()}} if self.perf_lower else {}),
            **({} if self.outside is None else {"outside_box": one(self.outside)}),
            "assumptions": {**self.assumptions.to_dict(), "hold": self.hold},
            "contradiction": self.contradiction,
            "warnings": list(self.warnings),
        }

    def _bound(self, name: str, estimate: Estimate | None) -> dict | None:
        """An estimate with what the bound rests on, whether it counts, and what it supposes where a guess may be right."""
        if not known(estimate):
            return None
        needs, is_subject = self.needs(name), self.about.get(name, self.subject) == self.subject
        supposed = [need.condition for need in needs if need.basis == GUESSED] if self.conditional(name) else []
        return {
            **estimate.to_dict(self.confidence),
            "rests_on": {need.name: need.basis for need in needs},
            "counts": self.counts(name) and is_subject,
            **({"if": " and ".join(supposed)} if supposed else {}),
        }

    def save(self, path: Path) -> None:
        """Write `certificate.json`."""
        path.write_text(json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @property
    def _handed_out(self) -> Side | None:
        return self._lowest(self.perf, lambda name: self.subject is None or name == self.subject)

    def _highest(self, usable: Callable[[str], bool]) -> Side | None:
        """The lower bound with the highest lower end among those that are ``usable``, and that end."""
        ends = [(name, e.interval(self.confidence)[0]) for name, e in known_of(self.lower).items() if usable(name)]
        return max(ends, key=lambda side: side[1], default=None)

    def _lowest(self, estimates: dict[str, Estimate | None], usable: Callable[[str], bool]) -> Side | None:
        """The one of ``estimates`` with the lowest upper end among those that are ``usable``, and that end."""
        ends = [(name, e.interval(self.confidence)[1]) for name, e in known_of(estimates).items() if usable(name)]
        return min(ends, key=lambda side: side[1], default=None)
