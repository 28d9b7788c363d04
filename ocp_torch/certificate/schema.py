"""A certificate as `certificate.json` holds it: a stable schema; what does not apply is null."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ocp_torch.certificate.bound import LOWER, PERFORMANCE, UPPER
from ocp_torch.certificate.estimate import known
from ocp_torch.problems.needs import GUESSED

if TYPE_CHECKING:
    from ocp_torch.certificate.certificate import Certificate

SCHEMA = 2


def to_dict(certificate: Certificate) -> dict:
    """The schema of ``certificate``, ready for JSON."""
    one = lambda e: e.to_dict(certificate.confidence) if known(e) else None
    bound = lambda name, e: (
        None if not known(e) else {**e.to_dict(certificate.confidence), **standing(certificate, name)}
    )
    below = certificate.perf_lower
    return {
        "schema": SCHEMA,
        **vars(certificate.run),
        "exact": certificate.exact,
        "confidence": certificate.confidence,
        "controller": certificate.controller,
        **{side: {n: bound(n, e) for n, e in getattr(certificate, side).items()} for side in (LOWER, UPPER)},
        **{group: {n: one(e) for n, e in getattr(certificate, group).items()} for group in ("perf", "baseline")},
        "gap": certificate.gap,
        "share": certificate.share,
        "suboptimality": certificate.suboptimality,
        **({PERFORMANCE: {name: one(e) for name, e in below.items()}} if below else {}),
        "assumptions": {**certificate.assumptions.to_dict(), "hold": certificate.hold},
        "contradiction": certificate.contradiction,
        "warnings": list(certificate.warnings),
    }


def standing(certificate: Certificate, name: str) -> dict:
    """What the bound ``name`` rests on, whether it counts, and what it supposes where a guess may be right."""
    needs = certificate.needs(name)
    guesses = [need.condition for need in needs if need.basis == GUESSED]
    supposed = " and ".join(guesses) if certificate.conditional(name) else ""
    counts = certificate.counts(name) and certificate.speaks.get(name, True)
    return {
        "rests_on": {need.name: need.basis for need in needs},
        "counts": counts,
        **({"if": supposed} if supposed else {}),
    }
