"""Bounds that exclude each other: then something that the problem says, or that a bound rests on, is not so."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

from ocp_torch.certificate.certificate import Certificate
from ocp_torch.certificate.estimate import Estimate, known_of
from ocp_torch.problems.needs import GUESSED

# Bounds contradict each other where their intervals at this joint level are apart,
LEVEL = 0.999
# and by more than so much of their size: equal numbers differ in the last digits of float64 and of what was given.
ROUNDING = 1e-9


def examined(certificate: Certificate) -> Certificate:
    """``certificate``, where a lower bound on `OPT` is above an upper one by more than their errors without anything that
    counts. A guess that is shown to be wrong in this way is dropped, with a warning, and the rest stands."""
    if not certificate.stands:
        return certificate
    truth = {} if certificate.exact is None else {"OPT": Estimate(certificate.exact, 0.0)}
    # Whatever any controller costs, doing nothing included, OPT does not exceed it.
    above = {n: e for n, e in known_of(certificate.upper).items() if certificate.counts(n)}
    above |= {f"Perf ({n})": e for n, e in known_of(certificate.perf | certificate.baseline).items()}
    lower = known_of(certificate.lower)
    below = {n: e for n, e in lower.items() if certificate.counts(n)}
    sound = [*product(below.items(), (above | truth).items()), *product(truth.items(), above.items())]
    supposed = {n: e for n, e in lower.items() if certificate.conditional(n)}
    guessed = [*product(supposed.items(), (above | truth).items())]
    level = 1.0 - (1.0 - LEVEL) / max(1, len(sound) + len(guessed))
    for (low, under), (high, over) in sound:
        if apart(under, over, level):
            sentence = (
                f"nothing is certified: {low} = {under.value:.6g}, a lower bound, contradicts {high} = {over.value:.6g}, an "
                f"upper one; {suspects(certificate, low, high)}."
            )
            return replace(certificate, contradiction=sentence, warnings=[sentence, *certificate.warnings])
    for (low, under), (high, over) in guessed:
        if apart(under, over, level):
            condition = " and ".join(need.condition for need in certificate.needs(low))
            note = f"{low} = {under.value:.6g} is above {high} = {over.value:.6g}: it is not so that {condition}."
            wrong = {need.name for need in certificate.needs(low) if need.basis == GUESSED}
            return replace(certificate, refuted=certificate.refuted | wrong, warnings=[*certificate.warnings, note])
    return certificate


def apart(under: Estimate, over: Estimate, level: float) -> bool:
    """Whether the interval of ``under`` lies above that of ``over``, both at ``level``."""
    return under.interval(level)[0] > over.interval(level)[1] + ROUNDING * abs(over.value)


def suspects(certificate: Certificate, *names: str) -> str:
    """What may be wrong where bounds of these names contradict each other."""
    conditions = list(dict.fromkeys(need.condition for name in names for need in certificate.needs(name)))
    doubts = f"either not {' or not '.join(conditions)}, or " if conditions else ""
    return f"{doubts}the problem's functions or constants are not what they are said to be"
